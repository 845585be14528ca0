//! The walks of up to sixteen rays side by side: the same steps as for one ray, so the same bits, but sorted by kind.
//!
//! Within a round all rays that stand before a node open it, then all that stand before a cell look into it. Loops
//! over like steps of different rays are predictable and independent, so that the processor overlaps what a single
//! ray does one after the other, and memory is asked for a round ahead.

use super::Pyramid;
use super::children::{Children, Line};
use super::walk::{Stack, Start, Step};
use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay};

/// Rays in a packet.
pub(super) const WIDTH: usize = 16;

/// A ray on its way.
struct Lane<'a, R> {
    start: Start<'a>,
    constants: R,
    stack: Stack,
    /// What was popped last.
    level: usize,
    child: [i32; 3],
}

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

impl<R> Lane<'_, R> {
    /// Pops what comes next, asks memory for it, and queues the lane for it; with nothing left it is done.
    #[inline(always)]
    #[allow(clippy::cast_sign_loss, reason = "numbers of nodes and cells are not negative")]
    fn queue<K: Children<Ray = R>>(
        &mut self,
        kernel: K,
        pyramid: &Pyramid,
        field: &Field,
        number: u8,
        [nodes, cells, done]: [&mut Queue; 3],
    ) {
        let more = self.stack.live != 0;
        done.push(number, !more);
        if more {
            (self.level, self.child) = self.stack.pop(&self.start.line);
            let child = self.child.map(|i| i as usize);
            if self.level > 0 {
                kernel.prefetch(pyramid.levels[self.level - 1].tile(child));
            } else {
                let [nx, ny, _] = field.lattice().dims();
                let at = (child[2] * ny + child[1]) * nx + child[0];
                let samples = &field.samples()[at..];
                kernel.prefetch(&samples[0]);
                kernel.prefetch(&samples[nx]);
                kernel.prefetch(&samples[nx * ny]);
                kernel.prefetch(&samples[nx * ny + nx]);
            }
        }
        nodes.push(number, more && self.level > 0);
        cells.push(number, more && self.level == 0);
    }
}

impl Pyramid {
    /// The walks of the rays whose bits are set in `active`; `ray` gives a ray and its reach.
    #[inline(always)]
    pub(super) fn walk16<const ANY: bool, K: Children>(
        &self,
        kernel: K,
        field: &Field,
        active: u16,
        ray: impl Fn(usize) -> FlattenedRay,
        hits: &mut [Option<FlattenedHit>; WIDTH],
    ) {
        let top = self.levels.len() - 1;
        if self.levels[top].dims != [1; 3] {
            // Several roots: not worth a second way.
            for (n, hit) in hits.iter_mut().enumerate().filter(|(n, _)| active >> n & 1 == 1) {
                let ray = ray(n);
                *hit = self.walk::<ANY, K>(kernel, field, &ray, f64::from(ray.reach));
            }
            return;
        }
        let mut lanes: [Option<Lane<K::Ray>>; WIDTH] = [const { None }; WIDTH];
        let mut nodes = Queue::default();
        for n in (0..WIDTH as u8).filter(|n| active >> n & 1 == 1) {
            let ray = ray(usize::from(n));
            match self.begin::<ANY, K>(kernel, field, &ray, f64::from(ray.reach)) {
                Err(done) => hits[usize::from(n)] = done,
                Ok(start) => {
                    let constants = kernel.ray(&start.line);
                    let stack = Stack::default();
                    lanes[usize::from(n)] = Some(Lane { start, constants, stack, level: top + 1, child: [0; 3] });
                    nodes.push(n, true);
                }
            }
        }
        let mut cells = Queue::default();
        while nodes.len + cells.len > 0 {
            let (mut next_nodes, mut next_cells, mut done) = (Queue::default(), Queue::default(), Queue::default());
            for n in nodes.lanes() {
                let Some(lane) = &mut lanes[usize::from(n)] else { continue };
                let line: &Line = &lane.start.line;
                self.open(kernel, line, &lane.constants, &mut lane.stack, lane.level, lane.child);
                lane.queue(kernel, self, field, n, [&mut next_nodes, &mut next_cells, &mut done]);
            }
            for n in cells.lanes() {
                let Some(lane) = &mut lanes[usize::from(n)] else { continue };
                match lane.start.ray.cell::<ANY>(&lane.start.line, lane.child, lane.start.departing) {
                    Step::On => {
                        lane.queue(kernel, self, field, n, [&mut next_nodes, &mut next_cells, &mut done]);
                    }
                    Step::Hit(hit) => hits[usize::from(n)] = Some(hit),
                    Step::End => {}
                }
            }
            if self.capped {
                for n in done.lanes() {
                    hits[usize::from(n)] = lanes[usize::from(n)].as_ref().and_then(|lane| self.leave(&lane.start.ray));
                }
            }
            (nodes, cells) = (next_nodes, next_cells);
        }
    }
}
