//! What the world's axes mean in a patient.

/// Where a patient's directions lie in the world: the first letter names what x grows towards, and so on. Coordinates
/// are never turned from one to the other; formats that hold the name pass it on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Space {
    /// Left, posterior, superior: that of DICOM and ITK, which is meant where nothing is said.
    #[default]
    LeftPosteriorSuperior,
    /// Right, anterior, superior: that of NIfTI.
    RightAnteriorSuperior,
    /// Left, anterior, superior.
    LeftAnteriorSuperior,
    /// None of a patient's: a scanner's, or just a right-handed one.
    Unnamed,
}

impl Space {
    /// NRRD's name, which [`Space::Unnamed`] has not.
    pub fn name(self) -> &'static str {
        match self {
            Space::LeftPosteriorSuperior => "left-posterior-superior",
            Space::RightAnteriorSuperior => "right-anterior-superior",
            Space::LeftAnteriorSuperior => "left-anterior-superior",
            Space::Unnamed => "no patient's",
        }
    }

    /// Its initials, where 3D Slicer knows them of meshes.
    pub fn of_mesh(self) -> Option<&'static str> {
        match self {
            Space::LeftPosteriorSuperior => Some("LPS"),
            Space::RightAnteriorSuperior => Some("RAS"),
            Space::LeftAnteriorSuperior | Space::Unnamed => None,
        }
    }

    /// The space of a [`Space::name`] or its initials.
    pub fn from_name(name: &str) -> Option<Self> {
        match name.to_ascii_lowercase().as_str() {
            "left-posterior-superior" | "lps" => Some(Space::LeftPosteriorSuperior),
            "right-anterior-superior" | "ras" => Some(Space::RightAnteriorSuperior),
            "left-anterior-superior" | "las" => Some(Space::LeftAnteriorSuperior),
            "no patient's" | "none" => Some(Space::Unnamed),
            _ => None,
        }
    }
}
