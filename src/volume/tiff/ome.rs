//! The steps between samples that OME's XML gives, each with a unit of its own.

use glam::DVec3;
use roxmltree::Node;

/// The steps along x, y and z of a `Pixels` element: in micrometres, or, if all are in the same unit without a known
/// length (`pixel`, `reference frame`, words that OME does not define), the numbers as they are. A step that is missing
/// or not positive is 1, whatever its unit.
///
/// # Errors
/// A message that names the attribute whose unit does not go together with another axis'.
pub(super) fn spacing(pixels: Node) -> Result<DVec3, String> {
    let mut spacing = DVec3::ONE;
    let mut first: Option<(String, &str)> = None;
    for (a, axis) in ["X", "Y", "Z"].into_iter().enumerate() {
        let step = pixels.attribute(format!("PhysicalSize{axis}").as_str()).and_then(|v| v.trim().parse::<f64>().ok());
        let Some(step) = step.filter(|v| *v > 0.0 && v.is_finite()) else { continue };
        let key = format!("PhysicalSize{axis}Unit");
        let unit = pixels.attribute(key.as_str()).map_or("µm", str::trim);
        let length = micrometres(unit);
        spacing[a] = step * length.unwrap_or(1.0);
        match &first {
            Some((other, known)) if *known != unit && (length.is_none() || micrometres(known).is_none()) => {
                return Err(format!(
                    "{key} is `{unit}`, but {other} is `{known}`: one of them has no length that is known, so that the \
                     steps cannot be compared; give all axes the same unit"
                ));
            }
            Some(_) => {}
            None => first = Some((key, unit)),
        }
    }
    Ok(spacing)
}

/// Whether pages are slices in order: `TiffData` may give each page (`IFD`) another slice (`FirstZ`).
///
/// # Errors
/// A message that names the first page that is another slice.
pub(super) fn check_order(pixels: Node) -> Result<(), String> {
    for data in pixels.children().filter(|n| n.tag_name().name() == "TiffData") {
        let number = |key: &str| data.attribute(key).and_then(|v| v.trim().parse::<u64>().ok()).unwrap_or(0);
        let (page, slice) = (number("IFD"), number("FirstZ"));
        if page != slice {
            return Err(format!(
                "OME's text says that page {page} is slice {slice} (TiffData); save it anew with the slices in order"
            ));
        }
    }
    Ok(())
}

/// The length of a unit of OME's `UnitsLength`; `None` for those without one and for unknown words.
fn micrometres(unit: &str) -> Option<f64> {
    const INCH: f64 = 25_400.0;
    const ASTRONOMICAL: f64 = 149_597_870_700e6;
    Some(match unit {
        "Ym" => 1e30,
        "Zm" => 1e27,
        "Em" => 1e24,
        "Pm" => 1e21,
        "Tm" => 1e18,
        "Gm" => 1e15,
        "Mm" => 1e12,
        "km" => 1e9,
        "hm" => 1e8,
        "dam" => 1e7,
        "m" => 1e6,
        "dm" => 1e5,
        "cm" => 1e4,
        "mm" => 1e3,
        // The micro sign, and the Greek letter that looks like it.
        "\u{b5}m" | "\u{3bc}m" => 1.0,
        "nm" => 1e-3,
        "pm" => 1e-6,
        "fm" => 1e-9,
        "am" => 1e-12,
        "zm" => 1e-15,
        "ym" => 1e-18,
        // The letter, and the sign of the unit.
        "\u{c5}" | "\u{212b}" => 1e-4,
        "ua" => ASTRONOMICAL,
        "ly" => 9.460_730_472_580_8e21,
        "pc" => ASTRONOMICAL * 648_000.0 / std::f64::consts::PI,
        "thou" => INCH / 1000.0,
        // A line is a twelfth of an inch, a point a seventy-second.
        "li" => INCH / 12.0,
        "pt" => INCH / 72.0,
        "in" => INCH,
        "ft" => 12.0 * INCH,
        "yd" => 36.0 * INCH,
        "mi" => 63_360.0 * INCH,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(attributes: &str) -> Result<DVec3, String> {
        let text = format!("<Pixels {attributes}/>");
        spacing(roxmltree::Document::parse(&text).unwrap().root_element())
    }

    fn in_unit(x: &str, unit: &str) -> f64 {
        let text = format!("PhysicalSizeX='{x}' PhysicalSizeXUnit='{unit}' PhysicalSizeY='2' PhysicalSizeYUnit='µm'");
        let spacing = of(&text).unwrap();
        assert_eq!((spacing.y, spacing.z), (2.0, 1.0));
        spacing.x
    }

    #[test]
    fn every_unit_of_length_is_converted() {
        // Each of these is one millimetre, or as many micrometres as said.
        for (x, unit) in [
            ("1e-27", "Ym"),
            ("1e-24", "Zm"),
            ("1e-21", "Em"),
            ("1e-18", "Pm"),
            ("1e-15", "Tm"),
            ("1e-12", "Gm"),
            ("1e-9", "Mm"),
            ("1e-6", "km"),
            ("1e-5", "hm"),
            ("1e-4", "dam"),
            ("1e-3", "m"),
            ("0.01", "dm"),
            ("0.1", "cm"),
            ("1", "mm"),
            ("1e3", "µm"),
            ("1e3", "\u{3bc}m"),
            ("1e6", "nm"),
            ("1e9", "pm"),
            ("1e12", "fm"),
            ("1e15", "am"),
            ("1e18", "zm"),
            ("1e21", "ym"),
            ("1e7", "Å"),
            ("1e7", "\u{212b}"),
        ] {
            assert!((in_unit(x, unit) - 1000.0).abs() < 1e-9, "{unit}");
        }
        for (unit, micrometres) in [
            ("thou", 25.4),
            ("pt", 352.777_777_777_777_8),
            ("li", 2_116.666_666_666_666_5),
            ("in", 25_400.0),
            ("ft", 304_800.0),
            ("yd", 914_400.0),
            ("mi", 1_609_344_000.0),
            ("ua", 1.495_978_707e17),
            ("ly", 9.460_730_472_580_8e21),
            ("pc", 3.085_677_581_491_367e22),
        ] {
            assert!((in_unit("1", unit) / micrometres - 1.0).abs() < 1e-14, "{unit}");
        }
    }

    #[test]
    fn units_without_a_length_are_kept_or_refused() {
        let of = |x: &str, y: &str, z: &str| {
            let unit =
                |axis: &str, u: &str| if u.is_empty() { u.into() } else { format!("PhysicalSize{axis}Unit='{u}'") };
            let sizes = "PhysicalSizeX='0.5' PhysicalSizeY='3' PhysicalSizeZ='7'";
            of(&format!("{sizes} {} {} {}", unit("X", x), unit("Y", y), unit("Z", z)))
        };
        let numbers = DVec3::new(0.5, 3.0, 7.0);
        for unit in ["pixel", "reference frame", "cubit", "µm", ""] {
            assert_eq!(of(unit, unit, unit), Ok(numbers), "{unit}");
        }
        assert_eq!(of("nm", "", "mm"), Ok(DVec3::new(0.0005, 3.0, 7000.0)));
        for (x, y, z, says) in [
            ("pixel", "pixel", "", "PhysicalSizeZUnit is `µm`, but PhysicalSizeXUnit is `pixel`"),
            ("", "cubit", "", "PhysicalSizeYUnit is `cubit`, but PhysicalSizeXUnit is `µm`"),
            ("pixel", "reference frame", "pixel", "PhysicalSizeYUnit is `reference frame`"),
            ("nm", "µm", "pixel", "PhysicalSizeZUnit is `pixel`"),
        ] {
            let message = of(x, y, z).unwrap_err();
            assert!(message.contains(says), "{message}");
        }
    }

    #[test]
    fn a_step_that_is_missing_is_one() {
        assert_eq!(of("PhysicalSizeY='2' PhysicalSizeZUnit='pixel'"), Ok(DVec3::new(1.0, 2.0, 1.0)));
        assert_eq!(of("PhysicalSizeX='0' PhysicalSizeXUnit='nm' PhysicalSizeZ='-1'"), Ok(DVec3::ONE));
    }
}
