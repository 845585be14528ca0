//! How much work a bake is worth, in one word.

use serde::{Deserialize, Serialize};

/// How much work a bake is worth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// Seconds: a first look.
    Preview,
    /// Minutes: fit to publish.
    #[default]
    Standard,
    /// As long as it takes.
    Reference,
}

/// What a preset stands for, by the names of [`super::BakeSettings`].
pub(super) struct Values {
    pub(super) directions: usize,
    pub(super) light_points: usize,
    pub(super) photons: u64,
    pub(super) samples_per_point: f64,
    pub(super) shadow_rays: u32,
    pub(super) gather_rays: u32,
    pub(super) cache_shadow_rays: u32,
    pub(super) wall_resolution: usize,
    pub(super) wall_isovalues: usize,
    pub(super) wall_shadow_rays: u32,
}

impl Preset {
    /// What it stands for.
    pub(super) const fn values(self) -> Values {
        match self {
            Preset::Preview => Values {
                directions: 64,
                light_points: 16,
                photons: 1 << 19,
                samples_per_point: 0.25,
                shadow_rays: 64,
                gather_rays: 32,
                cache_shadow_rays: 4,
                wall_resolution: 32,
                wall_isovalues: 16,
                wall_shadow_rays: 16,
            },
            Preset::Standard => Values {
                directions: 256,
                light_points: 64,
                photons: 1 << 22,
                samples_per_point: 1.0,
                shadow_rays: 256,
                gather_rays: 64,
                cache_shadow_rays: 4,
                wall_resolution: 64,
                wall_isovalues: 32,
                wall_shadow_rays: 32,
            },
            Preset::Reference => Values {
                directions: 512,
                light_points: 128,
                photons: 1 << 24,
                samples_per_point: 4.0,
                shadow_rays: 1024,
                gather_rays: 256,
                cache_shadow_rays: 16,
                wall_resolution: 128,
                wall_isovalues: 64,
                wall_shadow_rays: 128,
            },
        }
    }
}
