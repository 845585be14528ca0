//! BB09's table: where radiance is sampled, against the isovalue. \[BB09 §3\]

use super::figure6::{figure6, figure6_path};
use super::{Effort, Study, Subject, Table, accuracy_of, exactly, provenance};
use crate::bake::{BakeOptions, BakeSettings, Engine, StrategyName};
use crate::error::Result;
use crate::illumination_grid::GridSize;
use crate::mask::{Mask, masks};
use crate::plot::{Plot, Series};
use crate::volume::generate::bumps;

const COLUMNS: [&str; 16] = [
    "scene",
    "samples",
    "strategy",
    "isovalue",
    "taken",
    "percent_rms",
    "ci_lo",
    "ci_hi",
    "percent_rms_sqrt3",
    "percent_rms_area",
    "percent_rms_lit",
    "max",
    "seconds",
    "cpu_seconds",
    "job",
    "program",
];

const STRATEGIES: [(StrategyName, &str); 4] = [
    (StrategyName::LevelSet, "level-set"),
    (StrategyName::Planes, "planes"),
    (StrategyName::Uniform, "uniform"),
    (StrategyName::Nodes, "nodes"),
];

/// Error of the strategies at 10⁵, 10⁶ and 10⁷ samples over the whole sweep, and Figure 6 at 10⁶. `nodes` takes its
/// samples at the points of a grid as fine as they allow; the others interpolate onto the volume's lattice.
///
/// # Errors
/// `Invalid` if a subject has no surface at any isovalue that is compared; as bakes, references and tables.
pub fn strategies(study: &Study, subjects: &[Subject], base: &BakeOptions) -> Result<()> {
    let mut table = Table::open(study.folder.join("strategies.csv"), &COLUMNS, 4)?;
    let counts: &[u64] = if study.quick { &[20_000, 100_000] } else { &[100_000, 1_000_000, 10_000_000] };
    let jobs = study.jobs(&table, subjects, base, &["engine", "samples", "strategy"])?;
    let isovalues = subjects.iter().map(|s| isovalues(study, s)).collect::<Result<Vec<_>>>()?;
    let works: Vec<Work> = subjects
        .iter()
        .zip(jobs)
        .zip(isovalues)
        .map(|((subject, job), isovalues)| Work { subject, job, isovalues })
        .collect();
    // Plots of what is there, also after an interrupt.
    let measured = measure(study, &works, base, counts, &mut table);
    summarise(study, &works, &table, counts)?;
    measured
}

/// What is measured of a subject.
struct Work<'a> {
    subject: &'a Subject,
    /// The rows' last columns.
    job: [String; 2],
    /// Where bakes are compared, source units.
    isovalues: Vec<f64>,
}

fn measure(study: &Study, works: &[Work], base: &BakeOptions, counts: &[u64], table: &mut Table) -> Result<()> {
    for Work { subject, job, isovalues } in works {
        for &count in counts {
            for (strategy, name) in STRATEGIES {
                let key = |c: f64| vec![subject.name.clone(), count.to_string(), name.to_owned(), exactly(c)];
                let pictured = strategy != StrategyName::Nodes && count == counts[1];
                if isovalues.iter().all(|&c| table.has(&key(c)))
                    && (!pictured || figure6_path(study, subject, name).is_file())
                {
                    continue;
                }
                study.say(&format!("{}: {count} samples, {name}", subject.name));
                let mut options = BakeOptions {
                    engine: Some(Engine::Photon),
                    samples: Some(count),
                    strategy: Some(strategy),
                    ..BakeOptions::default()
                };
                if strategy == StrategyName::Nodes {
                    options.grid = Some(grid_of(subject, count)?);
                }
                let (bake, seconds) = study.bake(subject, &BakeSettings::new(&options.or(base), &subject.scene)?)?;
                for &c in isovalues {
                    if table.has(&key(c)) {
                        continue;
                    }
                    let effort = if is_in_table(subject, c) { Effort::Table } else { Effort::Curve };
                    let references = study.references(subject, c, effort)?;
                    let a = accuracy_of(&subject.scene, &bake, &references)?;
                    let mut row = key(c);
                    row.push(bake.report.samples.to_string());
                    let numbers = [
                        a.percent_rms,
                        a.confidence[0],
                        a.confidence[1],
                        a.percent_rms_sqrt3,
                        a.percent_rms_area,
                        a.percent_rms_lit,
                        a.max,
                        seconds[0],
                        seconds[1],
                    ];
                    row.extend(numbers.map(|x| format!("{x:.4}")));
                    row.extend(job.clone());
                    table.push(row)?;
                }
                if pictured {
                    figure6(study, subject, name, strategy, bake)?;
                }
            }
        }
    }
    Ok(())
}

/// The largest grid of Ω's proportions that takes at most `count` samples, or what costs as much: points that others
/// around stand for take more of them, of fewer rays.
///
/// # Errors
/// `Invalid` if it has too many points.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "counts")]
fn grid_of(subject: &Subject, count: u64) -> Result<GridSize> {
    let field = &subject.scene.field;
    let dims = subject.scene.lattice().dims();
    let mut factor = 1.0f64;
    let mut tried = 0;
    loop {
        tried += 1;
        let grid = GridSize::Points(dims.map(|n| ((n as f64 * factor) as usize).max(2)));
        let lattice = grid.lattice(subject.scene.lattice())?;
        let samples = masks(field, &lattice).iter().filter(|m| **m != Mask::Empty).count() as u64;
        if samples <= count && samples as f64 > 0.9 * count as f64 || lattice.len() == 8 || tried == 32 {
            return Ok(grid);
        }
        factor *= (0.97 * count as f64 / samples.max(1) as f64).cbrt();
    }
}

/// Whether an isovalue is among those that are read off the table rather than the plot.
fn is_in_table(subject: &Subject, isovalue: f64) -> bool {
    // The same numbers as `isovalues` makes: those of narrow sweeps lie closer together than any tolerance.
    let fixed = bumps::TABLE.map(|c| subject.at(bumps::fraction(c)));
    isovalue == subject.main_isovalue() || fixed.contains(&isovalue)
}

/// Level sets of strategy 1, the middles between them, 35, 47 and 80 of [3.6, 95], a regular comb, and the isovalue
/// that is reported first, where there is a surface; source units, increasing.
///
/// # Errors
/// `Invalid` if there is none.
fn isovalues(study: &Study, subject: &Subject) -> Result<Vec<f64>> {
    let mut fractions = bumps::level_sets();
    if !study.quick {
        fractions.extend(bumps::level_sets().windows(2).map(|w| 0.5 * (w[0] + w[1])));
        fractions.extend((1..=9).map(|i| f64::from(i) / 10.0));
    }
    let main = bumps::TABLE.map(bumps::fraction);
    fractions.retain(|f| main.iter().all(|m| (f - m).abs() > 0.008));
    fractions.extend(if study.quick { &main[1..2] } else { &main[..] });
    fractions.sort_by(f64::total_cmp);
    fractions.dedup_by(|a, b| (*a - *b).abs() < 0.008);
    // Elsewhere no row ever says that a bake was compared.
    let mut all: Vec<f64> = fractions.into_iter().map(|f| subject.at(f)).collect();
    all.push(subject.main_isovalue());
    all.sort_by(f64::total_cmp);
    all.dedup();
    subject.with_surfaces(&all)
}

/// A number for a sentence, without the last digits of rounding.
fn shortly(x: f64) -> String {
    let rounded: f64 = format!("{x:.6e}").parse().unwrap_or(x);
    rounded.to_string()
}

/// Tables and plots of what is measured so far, and says so where that is not all.
fn summarise(study: &Study, works: &[Work], table: &Table, counts: &[u64]) -> Result<()> {
    let mut notes = String::from("RMS over the isovalues | at the isovalue that is reported first:\n\n");
    for Work { subject, isovalues, .. } in works {
        let sweep = subject.scene.field.sweep();
        let (c, lo, hi) = (shortly(subject.main_isovalue()), shortly(sweep.lo()), shortly(sweep.hi()));
        notes += &format!("* {}: at {c} of [{lo}, {hi}]\n", subject.name);
        let main = exactly(subject.main_isovalue());
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
                let (done, all) = (rows.len(), isovalues.len());
                let rms = if done < all { format!("{done} of {all} isovalues so far") } else { format!("{rms:.3}") };
                let at_main = match rows.iter().find(|r| r[3] == main) {
                    Some(row) => format!("{:.3}", table.number(row, "percent_rms")),
                    None if isovalues.contains(&subject.main_isovalue()) => "not yet".into(),
                    None => "no surface".into(),
                };
                notes += &format!("* {}, {count} samples, {name}: {rms} | {at_main}\n", subject.name);
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
            guides: bumps::level_sets().into_iter().map(|f| subject.at(f)).collect(),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::embree::Device;
    use crate::progress::Progress;
    use crate::study::tests::subject;

    /// A sweep [3.6e-6, 95e-6] whose main isovalue is none of those that all subjects share, though near one.
    #[test]
    fn the_isovalue_of_a_subject_is_compared_and_reported() {
        let dir = tempfile::tempdir().unwrap();
        let study = Study::new(dir.path().into(), Device::new(1).unwrap(), Progress::Quiet, true).unwrap();
        let mut subject = subject(0.5);
        let shared = isovalues(&study, &subject).unwrap();
        assert_eq!(shared.iter().filter(|&&c| c == subject.main_isovalue()).count(), 1, "{shared:?}");
        let main = subject.main_isovalue() + 1e-8;
        subject.isovalue = Some(main);
        let all = isovalues(&study, &subject).unwrap();
        assert_eq!(all.len(), shared.len() + 1);
        assert!(all.contains(&main) && all.is_sorted() && is_in_table(&subject, main), "{all:?}");

        let mut table = Table::open(dir.path().join("t.csv"), &COLUMNS, 4).unwrap();
        for (c, error) in [(all[0], "3"), (main, "4")] {
            let mut row: Vec<String> = ["s", "20000", "level-set"].map(str::to_owned).to_vec();
            row.extend([exactly(c), "1".into(), error.into()]);
            row.resize(COLUMNS.len(), "0".into());
            table.push(row).unwrap();
        }
        let summarised = |isovalues: &[f64]| {
            let work = Work { subject: &subject, job: Default::default(), isovalues: isovalues.to_vec() };
            summarise(&study, &[work], &table, &[20_000]).unwrap();
            std::fs::read_to_string(dir.path().join("strategies.md")).unwrap()
        };
        // What an interrupt leaves is no RMS of all.
        let notes = summarised(&all);
        let so_far = format!("s, 20000 samples, level-set: 2 of {} isovalues so far | 4.000", all.len());
        assert!(notes.contains(&so_far), "{notes}");
        let notes = summarised(&[all[0], main]);
        assert!(notes.contains("s: at 0.00004701 of [0.0000036, 0.000095]"), "{notes}");
        assert!(notes.contains("s, 20000 samples, level-set: 3.536 | 4.000"), "√12.5 and what stands at it: {notes}");
        assert_eq!(shortly(20.000_000_000_000_004), "20");
    }
}
