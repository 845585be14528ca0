//! BB09's table: where radiance is sampled, against the isovalue. \[BB09 §3\]

use super::{Study, Subject, Table, accuracy_of, provenance};
use crate::bake::{BakeOptions, BakeSettings, StrategyName};
use crate::error::Result;
use crate::plot::{Plot, Series};

const COLUMNS: [&str; 12] = [
    "scene",
    "samples",
    "strategy",
    "isovalue",
    "percent_rms",
    "ci_lo",
    "ci_hi",
    "percent_rms_sqrt3",
    "percent_rms_area",
    "percent_rms_lit",
    "max",
    "seconds",
];

const STRATEGIES: [(StrategyName, &str); 4] = [
    (StrategyName::LevelSet, "level-set"),
    (StrategyName::Planes, "planes"),
    (StrategyName::Uniform, "uniform"),
    (StrategyName::Nodes, "nodes"),
];

/// Error of the strategies at 10⁶ and 10⁷ samples over the whole sweep. `nodes` samples each grid point once, whatever the
/// count.
///
/// # Errors
/// As bakes, references and tables.
pub fn strategies(study: &Study, subjects: &[Subject], base: &BakeOptions) -> Result<()> {
    let mut table = Table::open(study.folder.join("strategies.csv"), &COLUMNS, 4)?;
    let counts: &[u64] = if study.quick { &[20_000, 100_000] } else { &[1_000_000, 10_000_000] };
    for subject in subjects {
        let isovalues = isovalues(study, subject);
        for &count in counts {
            for (strategy, name) in STRATEGIES {
                if strategy == StrategyName::Nodes && count != counts[0] {
                    continue;
                }
                let key = |c: f64| vec![subject.name.clone(), count.to_string(), name.to_owned(), format!("{c:.3}")];
                if isovalues.iter().all(|&c| table.has(&key(c))) {
                    continue;
                }
                study.say(&format!("{}: {count} samples, {name}", subject.name));
                let options = BakeOptions { samples: Some(count), strategy: Some(strategy), ..BakeOptions::default() };
                let (bake, seconds) = study.bake(subject, &BakeSettings::new(&options.or(base))?)?;
                for &c in &isovalues {
                    if table.has(&key(c)) {
                        continue;
                    }
                    let Some(references) = study.references(subject, c)? else { continue };
                    let a = accuracy_of(&bake, &references)?;
                    let mut row = key(c);
                    let numbers = [
                        a.percent_rms,
                        a.confidence[0],
                        a.confidence[1],
                        a.percent_rms_sqrt3,
                        a.percent_rms_area,
                        a.percent_rms_lit,
                        a.max,
                        seconds,
                    ];
                    row.extend(numbers.map(|x| format!("{x:.4}")));
                    table.push(row)?;
                }
            }
        }
    }
    summarise(study, subjects, &table, counts)
}

/// Level sets of strategy 1, the middles between them, 47.0, and a regular comb; source units, increasing.
fn isovalues(study: &Study, subject: &Subject) -> Vec<f64> {
    let mut fractions: Vec<f64> = level_sets();
    fractions.push((47.0 - 3.6) / 91.4);
    if !study.quick {
        fractions.extend(level_sets().windows(2).map(|w| 0.5 * (w[0] + w[1])));
        fractions.extend((1..=15).map(|i| f64::from(i) / 16.0));
    }
    fractions.sort_by(f64::total_cmp);
    fractions.dedup_by(|a, b| (*a - *b).abs() < 0.004);
    fractions.into_iter().map(|f| subject.at(f)).collect()
}

/// BB09's level sets 39.0 + 17.7 k of the sweep [3.6, 95], as fractions.
fn level_sets() -> Vec<f64> {
    (-2..=3).map(|k| (39.0 + 17.7 * f64::from(k) - 3.6) / 91.4).filter(|s| (0.0..=1.0).contains(s)).collect()
}

fn summarise(study: &Study, subjects: &[Subject], table: &Table, counts: &[u64]) -> Result<()> {
    let mut notes = String::from("RMS over the isovalues | at 47.0 of [3.6, 95]:\n\n");
    for subject in subjects {
        let main = format!("{:.3}", subject.main_isovalue());
        let mut series = Vec::new();
        for &count in counts {
            for (_, name) in STRATEGIES {
                let rows: Vec<&Vec<String>> = table
                    .rows()
                    .iter()
                    .filter(|r| r[0] == subject.name && r[1] == count.to_string() && r[2] == name)
                    .collect();
                if rows.is_empty() {
                    continue;
                }
                let mut points: Vec<(f64, f64)> =
                    rows.iter().map(|r| (table.number(r, "isovalue"), table.number(r, "percent_rms"))).collect();
                points.sort_by(|a, b| a.0.total_cmp(&b.0));
                let rms = (points.iter().map(|p| p.1 * p.1).sum::<f64>() / points.len() as f64).sqrt();
                let at_main = rows.iter().find(|r| r[3] == main).map_or(f64::NAN, |r| table.number(r, "percent_rms"));
                notes += &format!("* {}, {count} samples, {name}: {rms:.3} | {at_main:.3}\n", subject.name);
                series.push(Series {
                    name: format!("{name} {count:.0e}", count = count as f64),
                    points,
                    line: true,
                    marks: true,
                });
            }
        }
        let plot = Plot {
            title: format!("{}: error against isovalue", subject.name),
            x_label: "isovalue (dashed: level sets of strategy 1)".into(),
            y_label: "percent RMS".into(),
            log_y: true,
            series,
            guides: level_sets().into_iter().map(|f| subject.at(f)).collect(),
            ..Plot::default()
        };
        plot.write(&study.folder.join(format!("strategies-{}.svg", subject.name)))?;
    }
    notes += &format!(
        "\nBB09 (level set, planes, uniform): 3.59, 9.55, 1.29 at 10⁶; 3.47, 9.57, 1.08 at 10⁷.\n\n{}",
        provenance(study)
    );
    table.write_markdown(&study.folder.join("strategies.md"), "Sampling strategies", &notes)
}
