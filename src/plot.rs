//! Line and scatter plots as SVG: what the tables of a study look like.

use crate::error::Result;
use crate::files;
use std::fmt::Write as _;
use std::path::Path;

/// Points of one colour, joined or not.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// (x, y); points that are not finite, or not positive on a logarithmic axis, are left out.
    pub points: Vec<(f64, f64)>,
    /// Whether a line joins them in their order.
    pub line: bool,
    /// Whether each has a mark.
    pub marks: bool,
}

/// One pair of axes.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    /// Above the axes.
    pub title: String,
    /// Below them.
    pub x_label: String,
    /// Left of them.
    pub y_label: String,
    /// Whether x is logarithmic.
    pub log_x: bool,
    /// Whether y is logarithmic; a linear y axis begins at 0.
    pub log_y: bool,
    /// What is drawn.
    pub series: Vec<Series>,
    /// Vertical lines to compare with.
    pub guides: Vec<f64>,
}

const WIDTH: f64 = 760.0;
const HEIGHT: f64 = 460.0;
/// Left, top, right, bottom.
const MARGINS: [f64; 4] = [70.0, 40.0, 190.0, 55.0];
/// Okabe and Ito's colours, told apart by all.
const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];

/// One axis: its range, in logarithms if `log`, and where it lies on the page.
struct Axis {
    range: [f64; 2],
    log: bool,
    page: [f64; 2],
}

impl Axis {
    fn new(values: impl Iterator<Item = f64>, log: bool, from_zero: bool, page: [f64; 2]) -> Self {
        let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
        for v in values {
            let v = if log { v.log10() } else { v };
            (lo, hi) = (lo.min(v), hi.max(v));
        }
        if !(lo <= hi) {
            (lo, hi) = (0.0, 1.0);
        }
        if from_zero && !log {
            lo = lo.min(0.0);
        }
        let pad = if hi > lo { 0.04 * (hi - lo) } else { 0.5 };
        Self { range: [if from_zero && lo == 0.0 { 0.0 } else { lo - pad }, hi + pad], log, page }
    }

    fn at(&self, v: f64) -> f64 {
        let v = if self.log { v.log10() } else { v };
        let [lo, hi] = self.range;
        self.page[0] + (v - lo) / (hi - lo) * (self.page[1] - self.page[0])
    }

    /// Ticks, at 1, 2, 5 × powers of ten, with their labels; where a logarithmic axis is too short for two of them, at
    /// all digits, or even steps.
    fn ticks(&self) -> Vec<(f64, String)> {
        if !self.log {
            return even_ticks(self.range);
        }
        let [lo, hi] = self.range;
        #[allow(clippy::cast_possible_truncation, reason = "exponents of what is plotted")]
        let (first, last) = (lo.floor() as i32, hi.ceil() as i32);
        let at = |digits: &[f64]| -> Vec<(f64, String)> {
            let all = (first..=last).flat_map(|e| digits.iter().map(move |d| d * 10f64.powi(e)));
            all.filter(|v| (lo..=hi).contains(&v.log10())).map(|v| (v, label(v, v))).collect()
        };
        let few: &[f64] = if hi - lo < 2.5 { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let all: Vec<f64> = (1..10).map(f64::from).collect();
        let enough = [few, &all].into_iter().map(at).find(|ticks| ticks.len() > 1);
        enough.unwrap_or_else(|| even_ticks([lo, hi].map(|v| 10f64.powf(v))))
    }
}

/// About six ticks at even steps, with their labels.
fn even_ticks([lo, hi]: [f64; 2]) -> Vec<(f64, String)> {
    let raw = (hi - lo) / 6.0;
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|s| s * power).into_iter().find(|s| *s >= raw).unwrap_or(raw);
    let first = (lo / step).ceil();
    let all = (0..12).map(|i| (first + f64::from(i)) * step).take_while(|v| *v <= hi + 1e-9 * step);
    all.map(|v| (v, label(v, step))).collect()
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// A number as an axis shows it, to the digit that tells it from one `step` away.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "digits of an f64")]
fn label(v: f64, step: f64) -> String {
    let exponent = |x: f64| x.abs().max(f64::MIN_POSITIVE).log10().floor();
    // As `{}` shows it without zeros at its end.
    let shortest = |text: String| text.parse::<f64>().unwrap_or(v);
    let last = exponent(step);
    if v == 0.0 || v.abs() < 1e-9 * step {
        "0".into()
    } else if (1e-3..1e5).contains(&v.abs()) {
        format!("{}", shortest(format!("{v:.0$}", (-last).clamp(0.0, 17.0) as usize)))
    } else {
        format!("{:e}", shortest(format!("{v:.0$e}", (exponent(v) - last).clamp(0.0, 17.0) as usize)))
    }
}

/// An SVG document that grows.
struct Page(String);

impl Page {
    fn put(&mut self, text: std::fmt::Arguments<'_>) {
        self.0.write_fmt(text).expect("strings take all that is written");
    }
}

impl Plot {
    /// The plot as an SVG document.
    fn to_svg(&self) -> String {
        let [left, top, right, bottom] = MARGINS;
        let points = || self.series.iter().flat_map(|s| s.points.iter().copied()).filter(|p| self.shows(p));
        let axes = [
            Axis::new(points().map(|p| p.0), self.log_x, false, [left, WIDTH - right]),
            Axis::new(points().map(|p| p.1), self.log_y, true, [HEIGHT - bottom, top]),
        ];
        let mut page = Page(format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\" \
             font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
        ));
        self.frame(&mut page, &axes);
        (0..self.series.len()).for_each(|n| self.curve(&mut page, &axes, n));
        page.0.push_str("</svg>\n");
        page.0
    }

    /// Whether its axes have a place for a point.
    fn shows(&self, &(x, y): &(f64, f64)) -> bool {
        x.is_finite() && y.is_finite() && (!self.log_x || x > 0.0) && (!self.log_y || y > 0.0)
    }

    /// Title, axes with their ticks and names, and guides.
    fn frame(&self, page: &mut Page, axes: &[Axis; 2]) {
        let [left, top, right, bottom] = MARGINS;
        let middle = 0.5 * (left + WIDTH - right);
        page.put(format_args!(
            "<text x=\"{middle}\" y=\"22\" text-anchor=\"middle\" font-size=\"15\">{}</text>\n",
            escaped(&self.title)
        ));
        for (v, label) in axes[0].ticks() {
            let x = axes[0].at(v);
            page.put(format_args!("<path d=\"M{x:.1} {top}V{:.1}\" stroke=\"#ddd\"/>", HEIGHT - bottom));
            page.put(format_args!(
                "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>\n",
                HEIGHT - bottom + 17.0,
            ));
        }
        for (v, label) in axes[1].ticks() {
            let y = axes[1].at(v);
            page.put(format_args!("<path d=\"M{left} {y:.1}H{:.1}\" stroke=\"#ddd\"/>", WIDTH - right));
            page.put(format_args!(
                "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>\n",
                left - 6.0,
                y + 4.0,
            ));
        }
        for &v in self.guides.iter().filter(|v| (axes[0].page[0]..=axes[0].page[1]).contains(&axes[0].at(**v))) {
            let x = axes[0].at(v);
            page.put(format_args!(
                "<path d=\"M{x:.1} {top}V{:.1}\" stroke=\"#999\" stroke-dasharray=\"3 3\"/>\n",
                HEIGHT - bottom
            ));
        }
        page.put(format_args!(
            "<path d=\"M{left} {top}V{y}H{x}\" fill=\"none\" stroke=\"black\"/>\n",
            y = HEIGHT - bottom,
            x = WIDTH - right
        ));
        page.put(format_args!(
            "<text x=\"{middle}\" y=\"{}\" text-anchor=\"middle\">{}</text>\n",
            HEIGHT - 14.0,
            escaped(&self.x_label)
        ));
        let y_middle = 0.5 * (top + HEIGHT - bottom);
        page.put(format_args!(
            "<text transform=\"translate(18 {y_middle}) rotate(-90)\" text-anchor=\"middle\">{}</text>\n",
            escaped(&self.y_label)
        ));
    }

    /// Series `n`, and its name.
    fn curve(&self, page: &mut Page, axes: &[Axis; 2], n: usize) {
        let [_, top, right, _] = MARGINS;
        let series = &self.series[n];
        let colour = COLOURS[n % COLOURS.len()];
        // Colours that come again are dashed and hollow.
        let (dash, fill) = match n / COLOURS.len() {
            0 => ("", colour),
            1 => (" stroke-dasharray=\"6 3\"", "white"),
            _ => (" stroke-dasharray=\"2 3\"", "white"),
        };
        let at: Vec<(f64, f64)> =
            series.points.iter().filter(|p| self.shows(p)).map(|p| (axes[0].at(p.0), axes[1].at(p.1))).collect();
        if series.line && at.len() > 1 {
            let path: Vec<String> = at.iter().map(|(x, y)| format!("{x:.1} {y:.1}")).collect();
            page.put(format_args!(
                "<path d=\"M{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\"{dash}/>\n",
                path.join("L")
            ));
        }
        if series.marks {
            for (x, y) in &at {
                page.put(format_args!(
                    "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.8\" fill=\"{fill}\" stroke=\"{colour}\"/>"
                ));
            }
            page.put(format_args!("\n"));
        }
        let (x, y) = (WIDTH - right + 14.0, top + 14.0 + 19.0 * n as f64);
        page.put(format_args!(
            "<circle cx=\"{x}\" cy=\"{:.1}\" r=\"4\" fill=\"{fill}\" stroke=\"{colour}\"/><text x=\"{}\" y=\"{y}\">{}</text>\n",
            y - 4.0,
            x + 10.0,
            escaped(&series.name)
        ));
    }

    /// Writes the plot.
    ///
    /// # Errors
    /// `Io`.
    pub fn write(&self, path: &Path) -> Result<()> {
        files::write_text(path, &self.to_svg())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_drawn_is_left_out() {
        let series = Series {
            name: "a<b".into(),
            points: vec![(1.0, 1.0), (10.0, f64::NAN), (100.0, 0.0), (100.0, 2.0)],
            line: true,
            marks: true,
        };
        let plot = Plot {
            log_x: true,
            log_y: true,
            series: vec![series, Series::default()],
            guides: vec![1e9],
            ..Plot::default()
        };
        let svg = plot.to_svg();
        assert_eq!(svg.matches("r=\"2.8\"").count(), 2);
        assert!(!svg.contains("NaN") && !svg.contains("inf") && svg.contains("a&lt;b"), "{svg}");
        assert!(!Plot::default().to_svg().contains("NaN"), "an empty plot");
    }

    #[test]
    fn ticks_are_round_and_inside() {
        let axis = Axis { range: [3.6, 95.0], log: false, page: [0.0, 1.0] };
        let values = |axis: &Axis| axis.ticks().into_iter().map(|t| t.0).collect::<Vec<_>>();
        let labels = |axis: &Axis| axis.ticks().into_iter().map(|t| t.1).collect::<Vec<_>>();
        assert_eq!((values(&axis), labels(&axis).join(" ")), (vec![20.0, 40.0, 60.0, 80.0], "20 40 60 80".into()));
        let axis = Axis { range: [-0.1, 1.1], log: true, page: [0.0, 1.0] };
        assert_eq!((values(&axis), labels(&axis).join(" ")), (vec![1.0, 2.0, 5.0, 10.0], "1 2 5 10".into()));
        let short = |lo: f64, hi: f64| labels(&Axis { range: [lo, hi].map(f64::log10), log: true, page: [0.0, 1.0] });
        assert_eq!(short(2.1, 4.7), ["3", "4"]);
        assert_eq!(short(22.0, 48.0), ["30", "40"]);
        assert_eq!(short(1.12, 1.93), ["1.2", "1.4", "1.6", "1.8"]);
        assert_eq!(short(2.995e-4, 3.101e-4), ["3e-4", "3.02e-4", "3.04e-4", "3.06e-4", "3.08e-4", "3.1e-4"]);
        let shown = |lo: f64, hi: f64| labels(&Axis { range: [lo, hi], log: false, page: [0.0, 1.0] });
        assert_eq!(shown(-0.29, 0.3), ["-0.2", "-0.1", "0", "0.1", "0.2", "0.3"]);
        assert_eq!(shown(110_000.0, 190_000.0), ["1.2e5", "1.4e5", "1.6e5", "1.8e5"]);
        assert_eq!(shown(1.1e-7, 3.6e-7), ["1.5e-7", "2e-7", "2.5e-7", "3e-7", "3.5e-7"]);
        for (lo, width) in
            [(50.0, 1e-7), (-50.0, 1e-7), (1e6, 3.0), (1e12, 0.7), (1e-5, 1e-9), (0.0, 1e-12), (3.0, 7e20)]
        {
            let mut all = shown(lo, lo + width);
            let count = all.len();
            all.dedup();
            assert!(count >= 3 && all.len() == count, "{all:?}");
        }
    }
}
