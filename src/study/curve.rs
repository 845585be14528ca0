//! Error against wall seconds: how every change of speed or accuracy is judged.

use super::{Study, Subject, Table, accuracy_of, provenance};
use crate::bake::{BakeOptions, BakeSettings, StrategyName};
use crate::error::Result;
use crate::plot::{Plot, Series};

const COLUMNS: [&str; 9] =
    ["scene", "strategy", "photons", "samples", "gather", "percent_rms", "worst", "seconds", "rays_per_second"];

/// Bakes over photons × samples × gather rays × strategy; the error is the RMS over five isovalues of the sweep.
///
/// # Errors
/// As bakes, references and tables.
pub fn curve(study: &Study, subjects: &[Subject], base: &BakeOptions) -> Result<()> {
    let mut table = Table::open(study.folder.join("curve.csv"), &COLUMNS, 5)?;
    let photons: &[u64] = if study.quick { &[1 << 17, 1 << 19] } else { &[1 << 18, 1 << 20, 1 << 22] };
    let samples: &[u64] = if study.quick { &[10_000, 100_000] } else { &[10_000, 100_000, 1_000_000] };
    let gathers: &[u32] = if study.quick { &[0, 16] } else { &[0, 16, 64, 256] };
    for subject in subjects {
        let fractions: &[f64] = if study.quick { &[0.475] } else { &[0.18, 0.344, 0.475, 0.617, 0.836] };
        let mut references = Vec::new();
        for &f in fractions {
            references.extend(study.references(subject, subject.at(f))?);
        }
        for (strategy, name) in [(StrategyName::Uniform, "uniform"), (StrategyName::Nodes, "nodes")] {
            for &photons in photons {
                for &samples in samples {
                    // Nodes have their own count.
                    if strategy == StrategyName::Nodes && samples != 10_000 {
                        continue;
                    }
                    for &gather in gathers {
                        let key: Vec<String> = vec![
                            subject.name.clone(),
                            name.into(),
                            photons.to_string(),
                            samples.to_string(),
                            gather.to_string(),
                        ];
                        if table.has(&key) {
                            continue;
                        }
                        study.say(&format!(
                            "{}: {name}, {photons} photons, {samples} samples, {gather} gather rays",
                            subject.name
                        ));
                        let options = BakeOptions {
                            strategy: Some(strategy),
                            photons: Some(photons),
                            samples: Some(samples),
                            gather_rays: Some(gather),
                            ..BakeOptions::default()
                        };
                        let (bake, seconds) = study.bake(subject, &BakeSettings::new(&options.or(base))?)?;
                        let (mut sum, mut worst) = (0.0, 0f64);
                        for r in &references {
                            let a = accuracy_of(&bake, r)?;
                            sum += a.percent_rms * a.percent_rms;
                            worst = worst.max(a.percent_rms);
                        }
                        let rms = (sum / references.len().max(1) as f64).sqrt();
                        let mut row = key;
                        row.extend([
                            format!("{rms:.4}"),
                            format!("{worst:.4}"),
                            format!("{seconds:.3}"),
                            format!("{:.0}", bake.report.rays_per_second),
                        ]);
                        table.push(row)?;
                    }
                }
            }
        }
    }
    summarise(study, subjects, &table)
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

fn summarise(study: &Study, subjects: &[Subject], table: &Table) -> Result<()> {
    let mut notes = String::new();
    for subject in subjects {
        let rows: Vec<&Vec<String>> = table.rows().iter().filter(|r| r[0] == subject.name).collect();
        let point = |r: &&Vec<String>| (table.number(r, "seconds"), table.number(r, "percent_rms"));
        let front = pareto(rows.iter().map(point).collect());
        notes += &format!("Pareto front of {}:\n\n", subject.name);
        for p in &front {
            if let Some(r) = rows.iter().find(|r| point(r) == *p) {
                notes += &format!("* {:.2} s, {:.3} %: {}\n", p.0, p.1, r[1..5].join(" "));
            }
        }
        let mut series: Vec<Series> = Vec::new();
        for r in &rows {
            let name = format!("{}, gather {}", r[1], r[4]);
            match series.iter_mut().find(|s| s.name == name) {
                Some(s) => s.points.push(point(r)),
                None => series.push(Series { name, points: vec![point(r)], line: false, marks: true }),
            }
        }
        series.push(Series { name: "Pareto front".into(), points: front, line: true, marks: false });
        let plot = Plot {
            title: format!("{}: error against time", subject.name),
            x_label: "wall seconds".into(),
            y_label: "percent RMS over five isovalues".into(),
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
