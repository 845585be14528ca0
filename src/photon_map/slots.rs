//! Where points of a lattice lie along an axis, and what they stand for.

use super::cells::Cells;

/// Points along x that are worked on at a time.
pub(super) const LANES: usize = 16;

/// What a point stands for along one axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    /// The node that it lies beside, and whether above.
    pub node: usize,
    pub up: bool,
    /// Its place, its cell of the lattice, and where in that.
    pub at: f64,
    pub cell: usize,
    pub inside: f32,
    /// The middle of what it stands for, from the point and as a place, and its width.
    pub offset: f32,
    pub centre: f32,
    pub width: f32,
    /// The first and the last node of the cells that this lies in.
    pub nodes: [usize; 2],
}

/// Slots along x, one to a node at most; the lists of what points stand for are [`LANES`] longer.
pub(super) struct Along {
    pub slots: Vec<Option<Slot>>,
    /// Whether points lie above their nodes.
    pub up: Vec<bool>,
    /// The same of all of them, if they are alike.
    pub all_up: Option<bool>,
    pub offset: Vec<f32>,
    pub centre: Vec<f32>,
    /// 0 where there is no point.
    pub width: Vec<f32>,
    /// Of the grid of bins.
    pub cell: Vec<usize>,
}

impl Slot {
    /// Where points lie, in steps beside a node: two to a cell are exact for cubics, such as |∇h|² (Gauss). At nodes
    /// gradients are differences of single pairs of samples, which noise makes larger than they are between them.
    pub(super) const BESIDE: f64 = 0.211_324_865_405_187_1;

    /// What a point beside a node stands for from `low` to `high` steps beside it.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the lattice")]
    fn new(node: usize, up: bool, [low, high]: [f64; 2], count: usize) -> Option<Self> {
        let middle = node as f64;
        let (low, high) = ((middle + low).max(0.0), (middle + high).min((count - 1) as f64));
        let at = middle + if up { Self::BESIDE } else { -Self::BESIDE };
        let cell = at as usize;
        (low < high).then(|| Self {
            node,
            up,
            at,
            cell,
            inside: (at - cell as f64) as f32,
            offset: (0.5 * (low + high) - at) as f32,
            centre: (0.5 * (low + high)) as f32,
            width: (high - low) as f32,
            nodes: [low.floor() as usize, high.ceil() as usize],
        })
    }

    /// Half a step below a node, or above it.
    fn half(node: usize, up: bool, count: usize) -> Option<Self> {
        Self::new(node, up, if up { [0.0, 0.5] } else { [-0.5, 0.0] }, count)
    }

    /// The step around a node; points lie on either side by turns, and within the axis.
    fn whole(node: usize, count: usize) -> Option<Self> {
        let up = node == 0 || (node.is_multiple_of(2) && node + 1 < count);
        Self::new(node, up, [-0.5, 0.5], count)
    }

    /// All of an axis of `count` nodes, `fine` a step.
    pub(super) fn all(fine: usize, count: usize) -> Vec<Option<Self>> {
        let slot = |n: usize| match fine {
            1 => Self::whole(n, count),
            _ => Self::half(n / 2, n % 2 == 1, count),
        };
        (0..fine * count).map(slot).collect()
    }
}

impl Along {
    /// As [`Slot::all`]: one for every slot that nodes have.
    pub(super) fn all(fine: usize, cells: &Cells, count: usize) -> Vec<Self> {
        let slots = Slot::all(fine, count);
        (0..fine).map(|n| Self::new(slots.iter().skip(n).step_by(fine).copied().collect(), cells)).collect()
    }

    /// `slots`: by node.
    fn new(slots: Vec<Option<Slot>>, cells: &Cells) -> Self {
        let length = slots.len() + LANES;
        let none = || vec![0.0; length];
        let cell = (0..length).map(|n| n / cells.factor[0]).collect();
        let (up, all_up) = (vec![false; length], None);
        let mut along = Self { up, all_up, offset: none(), centre: none(), width: none(), cell, slots };
        for slot in along.slots.iter().flatten() {
            let n = slot.node;
            (along.offset[n], along.centre[n], along.width[n]) = (slot.offset, slot.centre, slot.width);
            along.up[n] = slot.up;
        }
        let mut sides = along.slots.iter().flatten().map(|slot| slot.up);
        let first = sides.next();
        along.all_up = first.filter(|&up| sides.all(|other| other == up));
        along
    }
}
