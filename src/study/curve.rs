//! Error against wall seconds: how every change of speed or accuracy is judged.

use super::{Effort, Study, Subject, Table, accuracy_of, provenance};
use crate::bake::{BakeOptions, BakeSettings, Engine, StrategyName, TimeEstimate};
use crate::error::Result;
use crate::plot::{Plot, Series};

const COLUMNS: [&str; 14] = [
    "scene",
    "way",
    "photons",
    "samples",
    "gather",
    "directions",
    "light_points",
    "percent_rms",
    "worst",
    "seconds",
    "cpu_seconds",
    "rays_per_second",
    "job",
    "program",
];

/// One way to bake.
struct Candidate {
    /// Engine and strategy, as the plot's series.
    name: &'static str,
    options: BakeOptions,
}

/// The photon engine over photons × samples × gather rays × strategy, and the sweep engine over directions × luminaire
/// points.
fn candidates(quick: bool) -> Vec<Candidate> {
    let photons: &[u64] = if quick { &[1 << 17, 1 << 19] } else { &[1 << 17, 1 << 19, 1 << 21] };
    let samples: &[u64] = if quick { &[10_000, 100_000] } else { &[100_000, 1_000_000] };
    let gathers: &[u32] = if quick { &[0, 16] } else { &[0, 16, 64] };
    // Directions, and points of each luminaire.
    let sweeps: &[[usize; 2]] =
        if quick { &[[32, 8], [64, 16]] } else { &[[32, 8], [64, 16], [64, 32], [128, 32], [128, 64], [256, 64]] };
    let mut out = Vec::new();
    for &photons in photons {
        for &gather in gathers {
            let exact = BakeOptions {
                engine: Some(Engine::Photon),
                photons: Some(photons),
                gather_rays: Some(gather),
                ..BakeOptions::default()
            };
            let nodes = BakeOptions { strategy: Some(StrategyName::Nodes), ..exact.clone() };
            out.push(Candidate { name: "nodes", options: nodes });
            for &samples in samples {
                let uniform =
                    BakeOptions { strategy: Some(StrategyName::Uniform), samples: Some(samples), ..exact.clone() };
                out.push(Candidate { name: "uniform", options: uniform });
            }
        }
    }
    for &[directions, light_points] in sweeps {
        let options = BakeOptions {
            engine: Some(Engine::Sweep),
            directions: Some(directions),
            light_points: Some(light_points),
            ..BakeOptions::default()
        };
        out.push(Candidate { name: "sweep", options });
    }
    out
}

/// Bakes in many ways, those that are estimated to take at most `limit` wall seconds; the error is the RMS over those
/// of five isovalues of the sweep that have a surface.
///
/// # Errors
/// As bakes, references and tables; `Invalid` if no such isovalue has a surface.
pub fn curve(study: &Study, subjects: &[Subject], base: &BakeOptions, limit: Option<f64>) -> Result<()> {
    let mut table = Table::open(study.folder.join("curve.csv"), &COLUMNS, 7)?;
    let varied: Vec<String> = candidates(study.quick).iter().flat_map(|c| c.options.set()).collect();
    let jobs = study.jobs(&table, subjects, base, &varied)?;
    let fractions: &[f64] = if study.quick { &[0.475] } else { &[0.18, 0.344, 0.475, 0.617, 0.836] };
    let compared = |s: &Subject| s.with_surfaces(&fractions.iter().map(|&f| s.at(f)).collect::<Vec<f64>>());
    let compared: Vec<Vec<f64>> = subjects.iter().map(compared).collect::<Result<_>>()?;
    for ((subject, job), isovalues) in subjects.iter().zip(&jobs).zip(&compared) {
        let mut references = Vec::new();
        for &c in isovalues {
            references.push(study.references(subject, c, Effort::Curve)?);
        }
        for Candidate { name, options } in candidates(study.quick) {
            let number = |n: Option<u64>| n.map_or_else(|| "-".to_owned(), |n| n.to_string());
            let key: Vec<String> = vec![
                subject.name.clone(),
                name.into(),
                number(options.photons),
                number(options.samples),
                number(options.gather_rays.map(u64::from)),
                number(options.directions.map(|n| n as u64)),
                number(options.light_points.map(|n| n as u64)),
            ];
            if table.has(&key) {
                continue;
            }
            let settings = BakeSettings::new(&options.or(base), &subject.scene)?;
            if let Some(limit) = limit {
                let estimate = TimeEstimate::new(&subject.scene, &settings, &study.device)?.total();
                if estimate > limit {
                    study.say(&format!("{}: {}: left out, about {estimate:.0} s", subject.name, described(&key)));
                    continue;
                }
            }
            study.say(&format!("{}: {}", subject.name, described(&key)));
            let (bake, seconds) = study.bake(subject, &settings)?;
            let (mut sum, mut worst) = (0.0, 0f64);
            for r in &references {
                let a = accuracy_of(&subject.scene, &bake, r)?;
                sum += a.percent_rms * a.percent_rms;
                worst = worst.max(a.percent_rms);
            }
            let rms = (sum / references.len().max(1) as f64).sqrt();
            let mut row = key;
            row.extend([
                format!("{rms:.4}"),
                format!("{worst:.4}"),
                format!("{:.3}", seconds[0]),
                format!("{:.3}", seconds[1]),
                format!("{:.0}", bake.report.rays_per_second),
            ]);
            row.extend(job.clone());
            table.push(row)?;
        }
    }
    let left_out = limit.map_or(String::new(), |s| format!("Ways estimated at more than {s} s were left out.\n\n"));
    let counts: Vec<usize> = compared.iter().map(Vec::len).collect();
    summarise(study, subjects, &counts, &table, &left_out)
}

/// What a row is about, in words.
fn described(row: &[String]) -> String {
    let units = ["photons", "samples", "gather rays", "directions", "light points"];
    let set = row[2..7].iter().zip(units).filter(|(n, _)| *n != "-").map(|(n, unit)| format!(", {n} {unit}"));
    set.fold(row[1].clone(), |text, part| text + &part)
}

/// The rows that no other beats in both seconds and error, by seconds.
fn pareto(mut points: Vec<(f64, f64)>) -> Vec<(f64, f64)> {
    points.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut best = f64::INFINITY;
    points.retain(|p| {
        let better = p.1 < best;
        best = best.min(p.1);
        better
    });
    points
}

/// `counts`: the isovalues compared of each subject.
fn summarise(study: &Study, subjects: &[Subject], counts: &[usize], table: &Table, left_out: &str) -> Result<()> {
    let mut notes = left_out.to_owned();
    for (subject, count) in subjects.iter().zip(counts) {
        let rows: Vec<&Vec<String>> = table.rows().iter().filter(|r| r[0] == subject.name).collect();
        let point = |r: &&Vec<String>| (table.number(r, "seconds"), table.number(r, "percent_rms"));
        let front = pareto(rows.iter().map(point).collect());
        notes += &format!("Pareto front of {}:\n\n", subject.name);
        for p in &front {
            if let Some(r) = rows.iter().find(|r| point(r) == *p) {
                notes += &format!("* {:.2} s, {:.3} %: {}\n", p.0, p.1, described(r));
            }
        }
        let mut series: Vec<Series> = Vec::new();
        for r in &rows {
            let name = if r[4] == "-" { r[1].clone() } else { format!("{}, gather {}", r[1], r[4]) };
            match series.iter_mut().find(|s| s.name == name) {
                Some(s) => s.points.push(point(r)),
                None => series.push(Series { name, points: vec![point(r)], line: false, marks: true }),
            }
        }
        series.push(Series { name: "Pareto front".into(), points: front, line: true, marks: false });
        let plot = Plot {
            title: format!("{}: error against time", subject.name),
            x_label: "wall seconds".into(),
            y_label: match count {
                1 => "percent RMS at one isovalue".into(),
                n => format!("percent RMS over {n} isovalues"),
            },
            log_x: true,
            log_y: true,
            series,
            ..Plot::default()
        };
        plot.write(&study.folder.join(format!("curve-{}.svg", subject.name)))?;
    }
    notes += &format!("\n{}", provenance(study));
    table.write_markdown(&study.folder.join("curve.md"), "Error against time", &notes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let front = pareto(vec![(3.0, 1.0), (1.0, 5.0), (2.0, 6.0), (4.0, 1.0), (2.5, 2.0)]);
        assert_eq!(front, [(1.0, 5.0), (2.5, 2.0), (3.0, 1.0)]);
    }
}
