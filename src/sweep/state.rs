//! Where a sweep stands between two passes, and the same as bytes for a checkpoint.

use super::SweepCounts;
use super::flats::Flats;
use super::half::Half4;
use super::lit_rows::LitRows;
use super::planes::{HalfPlanes, Planes, SignedPlanes};
use super::reflect::Reflected;
use super::settling::Settling;
use super::totals::{Deblur, Totals, stride};
use crate::scene::Scene;
use ::half::bf16;

/// What the finished replicates of a sweep gave.
pub(super) struct State {
    /// Light of the nodes; the direct light is that of all replicates before the first of them bounces it.
    pub total: Totals,
    /// Sums of the flats' reflected radiance.
    pub flats: Vec<Option<Vec<f32>>>,
    /// As in [`super::SweepResult`].
    pub bounces: usize,
    pub residual: f64,
    pub counts: SweepCounts,
}

/// A replicate between two passes. The flats hold the rest of it, their radiance.
pub(super) struct Passes {
    /// What the next pass reads.
    pub light: Reflected,
    /// While light settles: what the last pass read.
    pub before: Reflected,
    pub settling: Settling,
    /// Whether the level of the light has been corrected.
    pub corrected: bool,
    /// While light settles after that: what many directions brought more than few, per side.
    pub defect: Vec<SignedPlanes>,
    /// Passes since the light has settled.
    pub late: usize,
    /// Passes behind us.
    pub bounce: usize,
}

impl State {
    /// Before any bounce.
    pub(super) fn new(total: Totals) -> Self {
        Self { total, flats: Vec::new(), bounces: 0, residual: 0.0, counts: SweepCounts::default() }
    }

    /// Replicates that are finished.
    pub(super) fn done(&self) -> usize {
        self.total.done
    }

    /// Adds the indirect light of a replicate and what it left on the flats.
    pub(super) fn add(
        &mut self,
        indirect: &[Planes],
        flats: &Flats,
        (scene, rows, deblur): (&Scene, &LitRows, &Deblur),
    ) {
        self.total.add(indirect, (scene, rows), deblur);
        let radiance = || flats.textures.iter().map(|t| t.as_ref().map(|t| &t.radiance));
        if self.done() == 1 {
            self.flats = radiance().map(Option::<&Vec<f32>>::cloned).collect();
        } else {
            for (sum, new) in self.flats.iter_mut().zip(radiance()) {
                if let (Some(sum), Some(new)) = (sum, new) {
                    sum.iter_mut().zip(new).for_each(|(s, x)| *s += x);
                }
            }
        }
    }

    /// Takes note of how far a replicate came.
    pub(super) fn see(&mut self, passes: &Passes) {
        self.bounces = self.bounces.max(passes.bounce);
        let missing = match passes.settling.missing(0) {
            // From the light of replicates before.
            None if passes.late > 0 => 0.0,
            // Of all there will be, not of what there is.
            missing => missing.map_or(f64::NAN, |m| 1.0 - 1.0 / (1.0 + m)),
        };
        // f64::max passes over NaN.
        if missing.is_nan() || missing > self.residual {
            self.residual = missing;
        }
    }

    /// Everything as bytes, with the passes of a replicate that is under way.
    pub(super) fn bytes(&self, passes: Option<&Passes>, flats: &Flats) -> Vec<u8> {
        let Totals { places, lighting, direct, light, spread, parts, .. } = &self.total;
        let numbers = 12 * lighting.len() + 6 * (direct.len() + light.len()) + 3 * spread.len();
        let under_way = passes.map_or(0, |p| 6 * (p.light.b.len() + p.before.b.len() + p.defect.len()));
        // The flats are small beside it.
        let mut out = Writer { bytes: Vec::with_capacity(places * (numbers + under_way) + (1 << 16)) };
        out.count(self.done());
        out.count(self.bounces);
        out.real(self.residual);
        let c = self.counts;
        for n in [c.gather_rays, c.shadow_rays, c.families, c.valid] {
            out.bytes.extend(n.to_le_bytes());
        }
        out.count(self.total.lit);
        if self.total.lit > 0 {
            // Sums of direct light until they are all there.
            out.count(lighting.len());
            lighting.iter().flatten().for_each(|plane| out.numbers(plane));
            direct.iter().for_each(|d| out.half_planes(d));
            spread.iter().for_each(|s| out.halves(s.iter().map(|x| x.to_bits())));
            parts.iter().for_each(|p| out.numbers(p));
            flats.textures.iter().flatten().for_each(|t| out.numbers(&t.direct));
        }
        // None where nothing bounces.
        out.count(light.len());
        if self.done() > 0 {
            light.iter().for_each(|l| out.half_planes(l));
            self.flats.iter().flatten().for_each(|f| out.numbers(f));
        }
        out.count(usize::from(passes.is_some()));
        if let Some(p) = passes {
            out.count(p.bounce);
            out.count(p.late);
            for reflected in [&p.light, &p.before] {
                out.numbers(&[reflected.unit]);
                out.count(reflected.b.len());
                reflected.b.iter().for_each(|b| (0..3).for_each(|c| out.halves(b.iter().map(|b| b[c]))));
            }
            out.count(p.settling.passes);
            out.count(p.settling.since);
            p.settling.clone().reals().into_iter().flatten().for_each(|x| out.real(*x));
            out.count(usize::from(p.corrected));
            out.count(p.defect.len());
            p.defect.iter().flatten().for_each(|plane| out.halves(plane.iter().copied()));
            for t in flats.textures.iter().flatten() {
                out.numbers(&t.radiance);
                for some in [&t.before, &t.defect] {
                    out.count(some.len());
                    out.numbers(some);
                }
            }
        }
        out.bytes
    }

    /// Takes the state back from [`State::bytes`]; the passes of a replicate of `sides` that was under way are
    /// returned, and the flats take what belongs to them. Nothing is changed if the bytes do not fit.
    pub(super) fn restore(&mut self, bytes: &[u8], sides: usize, flats: &mut Flats) -> Option<Passes> {
        let Parsed { state, direct, passes } = self.parse(bytes, sides, flats)?;
        self.total = state.total;
        for (texture, direct) in flats.textures.iter_mut().flatten().zip(direct) {
            texture.direct = direct;
        }
        self.flats = state.flats;
        (self.bounces, self.residual, self.counts) = (state.bounces, state.residual, state.counts);
        let (passes, light) = passes?;
        for (texture, light) in flats.textures.iter_mut().flatten().zip(light) {
            [texture.radiance, texture.before, texture.defect] = light;
        }
        Some(passes)
    }

    fn parse(&self, bytes: &[u8], sides: usize, flats: &Flats) -> Option<Parsed> {
        let mut from = Reader { bytes };
        let (nodes, places) = (self.total.nodes, self.total.places);
        let mut state = Self::new(self.total.emptied());
        state.total.done = from.count()?;
        state.bounces = from.count()?;
        state.residual = from.real()?;
        let mut count = || from.count().map(|n| n as u64);
        state.counts =
            SweepCounts { gather_rays: count()?, shadow_rays: count()?, families: count()?, valid: count()? };
        state.flats = flats.textures.iter().map(|_| None).collect();
        state.total.lit = from.count()?;
        let mut direct = Vec::new();
        if state.total.lit > 0 {
            let lighting = from.count()?;
            if lighting > 0 {
                state.total.lighting = from.planes(sides, places)?;
            } else {
                state.total.direct = from.half_planes(sides, places)?;
            }
            for spread in &mut state.total.spread {
                *spread = from.halves(places)?.into_iter().map(bf16::from_bits).collect();
            }
            let parts = if state.total.spread.is_empty() { 0 } else { state.total.lit };
            let each = state.total.spread.len() * nodes.div_ceil(stride(nodes));
            state.total.parts = (0..parts).map(|_| from.numbers(each)).collect::<Option<_>>()?;
            for t in flats.textures.iter().flatten() {
                direct.push(from.numbers(t.direct.len())?);
            }
        }
        // Of every side or of none.
        let of = |count: usize| (count == 0 || count == sides).then_some(count);
        let bounced = from.count()?;
        if state.done() > 0 {
            state.total.light = from.half_planes(of(bounced)?, places)?;
            for (sum, texture) in state.flats.iter_mut().zip(&flats.textures) {
                if let Some(t) = texture {
                    *sum = Some(from.numbers(t.radiance.len())?);
                }
            }
        }
        let mut passes = None;
        if from.count()? == 1 {
            let (bounce, late) = (from.count()?, from.count()?);
            let mut reflected = || {
                let [unit] = from.numbers(1)?.try_into().ok()?;
                let b = (0..of(from.count()?)?).map(|_| from.four_halves(nodes)).collect::<Option<_>>()?;
                Some(Reflected { b, unit })
            };
            let (light, before) = (reflected()?, reflected()?);
            // What is gathered next is read without looking.
            if light.b.len() != sides {
                return None;
            }
            let mut settling = Settling::new([0.0; 3]);
            (settling.passes, settling.since) = (from.count()?, from.count()?);
            for three in settling.reals() {
                *three = from.three_of(Reader::real)?;
            }
            let (corrected, defects) = (from.count()? == 1, of(from.count()?)?);
            let defect = (0..defects).map(|_| from.three_of(|from| from.halves(places))).collect::<Option<_>>()?;
            let mut textures = Vec::new();
            for t in flats.textures.iter().flatten() {
                let radiance = from.numbers(t.radiance.len())?;
                let mut some = || {
                    let count = from.count()?.min(t.radiance.len());
                    from.numbers(count)
                };
                textures.push([radiance, some()?, some()?]);
            }
            passes = Some((Passes { light, before, settling, corrected, defect, late, bounce }, textures));
        }
        from.bytes.is_empty().then_some(Parsed { state, direct, passes })
    }
}

/// What the bytes of a state tell.
struct Parsed {
    state: State,
    /// Direct light of the flats that reflect.
    direct: Vec<Vec<f32>>,
    /// Passes under way, and these flats' radiance after the last pass and before it, and their defect.
    passes: Option<(Passes, Vec<[Vec<f32>; 3]>)>,
}

/// Numbers that are left out together if all are 0.
const RUN: usize = 512;

/// Numbers as little-endian bytes.
struct Writer {
    bytes: Vec<u8>,
}

impl Writer {
    fn count(&mut self, n: usize) {
        self.bytes.extend((n as u64).to_le_bytes());
    }

    fn real(&mut self, x: f64) {
        self.bytes.extend(x.to_le_bytes());
    }

    fn numbers(&mut self, numbers: &[f32]) {
        self.words(numbers.iter().map(|x| x.to_le_bytes()));
    }

    fn halves(&mut self, halves: impl ExactSizeIterator<Item = u16>) {
        self.words(halves.map(u16::to_le_bytes));
    }

    /// In runs of [`RUN`], each behind a byte that says whether any is not 0: what is not lit takes no room.
    fn words<const N: usize>(&mut self, mut words: impl ExactSizeIterator<Item = [u8; N]>) {
        let mut run = [[0; N]; RUN];
        while words.len() > 0 {
            let count = words.len().min(RUN);
            run.iter_mut().zip(words.by_ref().take(count)).for_each(|(to, word)| *to = word);
            let run = run[..count].as_flattened();
            let any = run.iter().fold(0, |any, byte| any | byte) != 0;
            self.bytes.push(u8::from(any));
            self.bytes.extend_from_slice(if any { run } else { &[] });
        }
    }

    fn half_planes(&mut self, light: &HalfPlanes) {
        self.numbers(&[light.unit]);
        light.planes.iter().for_each(|plane| self.halves(plane.iter().copied()));
    }
}

struct Reader<'a> {
    bytes: &'a [u8],
}

impl Reader<'_> {
    fn count(&mut self) -> Option<usize> {
        let (head, rest) = self.bytes.split_first_chunk()?;
        self.bytes = rest;
        usize::try_from(u64::from_le_bytes(*head)).ok()
    }

    fn real(&mut self) -> Option<f64> {
        let (head, rest) = self.bytes.split_first_chunk()?;
        self.bytes = rest;
        Some(f64::from_le_bytes(*head))
    }

    fn three_of<T>(&mut self, each: impl Fn(&mut Self) -> Option<T>) -> Option<[T; 3]> {
        Some([each(self)?, each(self)?, each(self)?])
    }

    fn numbers(&mut self, n: usize) -> Option<Vec<f32>> {
        self.words(n, f32::from_le_bytes)
    }

    fn halves(&mut self, n: usize) -> Option<Vec<u16>> {
        self.words(n, u16::from_le_bytes)
    }

    /// What [`Writer::words`] wrote of `n` numbers.
    fn words<T: Clone + Default, const N: usize>(&mut self, n: usize, number: impl Fn([u8; N]) -> T) -> Option<Vec<T>> {
        let mut numbers = Vec::with_capacity(n);
        while numbers.len() < n {
            let count = RUN.min(n - numbers.len());
            let (any, rest) = self.bytes.split_first()?;
            self.bytes = rest;
            if *any == 0 {
                numbers.resize(numbers.len() + count, T::default());
                continue;
            }
            let (run, rest) = self.bytes.split_at_checked(count * N)?;
            self.bytes = rest;
            numbers.extend(run.as_chunks().0.iter().map(|b| number(*b)));
        }
        Some(numbers)
    }

    fn four_halves(&mut self, n: usize) -> Option<Vec<Half4>> {
        let [r, g, b] = self.three_of(|from| from.halves(n))?;
        Some(r.into_iter().zip(g).zip(b).map(|((r, g), b)| [r, g, b, 0]).collect())
    }

    fn half_planes(&mut self, sides: usize, places: usize) -> Option<Vec<HalfPlanes>> {
        let mut side = || {
            let [unit] = self.numbers(1)?.try_into().ok()?;
            Some(HalfPlanes { planes: self.three_of(|from| from.halves(places))?, unit })
        };
        (0..sides).map(|_| side()).collect()
    }

    fn planes(&mut self, sides: usize, places: usize) -> Option<Vec<Planes>> {
        (0..sides).map(|_| self.three_of(|from| from.numbers(places))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flattened::Side;
    use crate::isovalue_axis::IsovalueAxis;

    /// Runs of zeros, numbers that are not, minus zero among zeros, and an end within a run.
    #[test]
    fn numbers_survive_and_zeros_take_no_room() {
        let n = 20 * RUN + 17;
        let mut numbers: Vec<f32> = (0..n).map(|i| if i / RUN % 5 == 3 { 1.0 + i as f32 } else { 0.0 }).collect();
        numbers[9 * RUN + 5] = -0.0;
        numbers[n - 1] = f32::NAN;
        let halves: Vec<u16> = numbers.iter().map(|x| (x.to_bits() >> 16) as u16).collect();
        let mut out = Writer { bytes: Vec::new() };
        out.numbers(&numbers);
        out.halves(halves.iter().copied());
        // Four whole runs, the one of minus zero and the end.
        assert_eq!(out.bytes.len(), 2 * 21 + (5 * RUN + 17) * (4 + 2));
        let read = |bytes: &[u8]| {
            let mut from = Reader { bytes };
            let both = (from.numbers(n)?, from.halves(n)?);
            from.bytes.is_empty().then_some(both)
        };
        let back = read(&out.bytes).unwrap();
        assert!(back.0.iter().map(|x| x.to_bits()).eq(numbers.iter().map(|x| x.to_bits())));
        assert_eq!(back.1, halves);
        for cut in [1, 17, out.bytes.len() / 2, out.bytes.len()] {
            assert_eq!(read(&out.bytes[..out.bytes.len() - cut]), None);
        }
    }

    /// Gathering reads light by number without looking: a state without it, or of another number of sides, is none.
    #[test]
    fn passes_under_way_have_light_of_all_sides() {
        let none = || Flats {
            textures: Vec::new(),
            count: 0,
            solid: Vec::new(),
            isovalues: 1,
            axis: IsovalueAxis::around(0.5),
            centres: Vec::new(),
            packed: Vec::new(),
        };
        let read = |lit: usize, before: usize, defects: usize| {
            let (sides, size) = (Side::BOTH, [4, 3]);
            let of = |count: usize| Reflected { b: vec![vec![[1, 2, 3, 0]; size[0]]; count], unit: 1.0 };
            let defect = (0..defects).map(|_| [0, 1, 2].map(|_| vec![0; size[1]])).collect();
            let settling = Settling::new([1.0; 3]);
            let passes =
                Passes { light: of(lit), before: of(before), settling, corrected: false, defect, late: 0, bounce: 1 };
            let mut state = State::new(Totals::new(&sides, 2, size, 1));
            let bytes = state.bytes(Some(&passes), &none());
            state.restore(&bytes, 2, &mut none()).map(|p| [p.light.b.len(), p.before.b.len(), p.defect.len()])
        };
        for whole in [[2, 0, 0], [2, 2, 0], [2, 2, 2]] {
            assert_eq!(read(whole[0], whole[1], whole[2]), Some(whole));
        }
        for wrong in [[0, 0, 0], [1, 2, 0], [3, 2, 0], [2, 1, 0], [2, 3, 0], [2, 2, 1], [2, 2, 3]] {
            assert_eq!(read(wrong[0], wrong[1], wrong[2]), None, "{wrong:?}");
        }
    }
}
