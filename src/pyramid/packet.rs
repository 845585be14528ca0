//! The walks of up to sixteen rays side by side: the same steps as for one ray, so the same bits, but sorted by kind.
//!
//! Within a round all rays that stand before a node open it, then all that stand before a cell look into it. Loops
//! over like steps of different rays are predictable and independent, so that the processor overlaps what a single
//! ray does one after the other, and memory is asked for a round ahead.

use super::Pyramid;
use super::kernel::Kernel;
use super::walk::{Begun, Child, Lane, Step};
use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay};

/// Rays in a packet.
pub(super) const WIDTH: usize = 16;

/// Lanes by number.
#[derive(Clone, Copy, Default)]
struct Queue {
    lanes: [u8; WIDTH],
    len: usize,
}

impl Queue {
    /// Appends `lane` if `really`, without a branch.
    #[inline(always)]
    fn push(&mut self, lane: u8, really: bool) {
        self.lanes[self.len % WIDTH] = lane;
        self.len += usize::from(really);
    }

    #[inline(always)]
    fn lanes(&self) -> impl Iterator<Item = u8> {
        let this = *self;
        (0..this.len.min(WIDTH)).map(move |i| this.lanes[i])
    }
}

/// What lanes do in a round.
#[derive(Clone, Copy, Default)]
struct Round {
    climbs: Queue,
    nodes: Queue,
    cells: Queue,
}

impl Round {
    /// Queues a lane for what comes next, without a branch. With nothing left it is done.
    #[inline(always)]
    fn queue<K: Kernel>(
        &mut self,
        kernel: K,
        pyramid: &Pyramid,
        memory: &[*const u8; 5],
        lane: &mut Lane<K::Constants>,
        number: u8,
    ) -> Child {
        let more = lane.stack.live != 0;
        let child = lane.pop(pyramid);
        self.climbs.push(number, !more & (lane.climbed < pyramid.levels.len()));
        self.nodes.push(number, more & (child.level > 0));
        self.cells.push(number, more & (child.level == 0));
        pyramid.ask(kernel, memory, &child);
        child
    }
}

impl Pyramid {
    /// Asks memory for what a child is read from: tile or samples. `memory`: where samples and levels begin.
    #[inline(always)]
    fn ask<K: Kernel>(&self, kernel: K, memory: &[*const u8; 5], child: &Child) {
        let children = &self.children[child.level];
        let at = memory[child.level].wrapping_add(child.at.wrapping_mul(children.bytes));
        for step in children.lines {
            kernel.ask(at.wrapping_add(step));
        }
    }

    /// The walks of the rays whose bits are set in `active`; `ray` gives a ray and its reach.
    #[inline(always)]
    pub(super) fn walk16<const ANY: bool, K: Kernel>(
        &self,
        kernel: K,
        field: &Field,
        active: u16,
        ray: impl Fn(usize) -> FlattenedRay,
        hits: &mut [Option<FlattenedHit>; WIDTH],
    ) {
        if self.roots != 1 {
            // Several roots: not worth a second way.
            for (n, hit) in hits.iter_mut().enumerate().filter(|(n, _)| active >> n & 1 == 1) {
                let ray = ray(n);
                *hit = self.walk::<ANY, K>(kernel, field, &ray, f64::from(ray.reach));
            }
            return;
        }
        let mut memory = [std::ptr::null(); 5];
        memory[0] = field.samples().as_ptr().cast();
        for (memory, level) in memory[1..].iter_mut().zip(&self.levels) {
            *memory = level.tiles.as_ptr().cast();
        }
        for n in (0..WIDTH).filter(|n| active >> n & 1 == 1) {
            self.ask(kernel, &memory, &self.start(ray(n).origin));
        }
        let mut lanes: [Option<Lane<K::Constants>>; WIDTH] = std::array::from_fn(|_| None);
        let mut next = [Child::default(); WIDTH];
        let mut round = Round::default();
        for n in (0..WIDTH as u8).filter(|n| active >> n & 1 == 1) {
            let (ray, number) = (ray(usize::from(n)), usize::from(n));
            match self.begin::<ANY, K>(kernel, field, &ray, f64::from(ray.reach), &mut lanes[number]) {
                Begun::Done(hit) => hits[number] = hit,
                Begun::On | Begun::Otherwise => round.climbs.push(n, true),
            }
        }
        while round.climbs.len + round.nodes.len + round.cells.len > 0 {
            let mut then = Round::default();
            for n in round.climbs.lanes() {
                let number = usize::from(n) % WIDTH;
                let Some(lane) = &mut lanes[number] else { continue };
                self.climb(kernel, lane);
                next[number] = then.queue(kernel, self, &memory, lane, n);
            }
            for n in round.nodes.lanes() {
                let number = usize::from(n) % WIDTH;
                let Some(lane) = &mut lanes[number] else { continue };
                self.open(kernel, lane, next[number]);
                next[number] = then.queue(kernel, self, &memory, lane, n);
            }
            for n in round.cells.lanes() {
                let number = usize::from(n) % WIDTH;
                let Some(lane) = &mut lanes[number] else { continue };
                match lane.cell::<ANY, K>(kernel, self.slack, next[number]) {
                    Step::On => next[number] = then.queue(kernel, self, &memory, lane, n),
                    Step::Hit(hit) => (hits[number], lane.capped) = (Some(hit), false),
                    Step::End => lane.capped = false,
                }
            }
            round = then;
        }
        if self.capped {
            for (hit, lane) in hits.iter_mut().zip(&lanes) {
                if let Some(lane) = lane.as_ref().filter(|lane| lane.capped) {
                    *hit = self.leave(&lane.ray);
                }
            }
        }
    }
}
