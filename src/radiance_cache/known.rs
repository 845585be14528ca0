//! What hits find between the cached nodes of one field.

use crate::field::Field;
use crate::node_set::NodeSet;
use glam::DVec3;

/// ε of the weights by which the nodes of a cell count.
const LEVEL: f64 = 0.1;

/// So many steps beside a cell without filled nodes some are looked for. (A fluid's points just outside the sweep send
/// a few rays in a hundred beyond 2 steps, one in a hundred beyond 5.)
const BESIDE: usize = 5;

/// What is known of one side of a field.
pub(super) struct Known<'a> {
    pub field: &'a Field,
    pub stored: &'a NodeSet,
    /// Of the nodes that are stored.
    pub values: &'a [[f32; 3]],
}

impl Known<'_> {
    /// What the node in `slot` holds, if it is filled.
    fn at(&self, slot: Option<usize>) -> Option<DVec3> {
        let value = self.values[slot?];
        (!value[0].is_nan()).then(|| DVec3::from_array(value.map(f64::from)))
    }

    /// The mean of the filled nodes of a cell for level set `isovalue` at place `u` in it. Each counts by
    /// w / (d² + ε Σ w d²), w being its trilinear weight and d how far off its isovalue is; so by w where all are as
    /// far off. Light mostly changes faster from level set to level set than along one.
    #[inline]
    pub(super) fn between(&self, [i, j, k]: [usize; 3], u: DVec3, isovalue: f32) -> Option<DVec3> {
        let field = self.field;
        // What each has to say, w and d².
        let (mut found, mut count) = ([(DVec3::ZERO, 0.0, 0.0); 8], 0);
        for row in 0..4 {
            let [y, z] = [row & 1, row >> 1];
            let across = (if y == 1 { u.y } else { 1.0 - u.y }, if z == 1 { u.z } else { 1.0 - u.z });
            let first = field.lattice().offset(i, j + y, k + z);
            let slots = self.stored.pair(first);
            for ((slot, along), h) in slots.into_iter().zip([1.0 - u.x, u.x]).zip(&field.samples()[first..]) {
                let Some(value) = self.at(slot) else { continue };
                let off = f64::from(h - isovalue);
                // 1e-6 keeps a hit at a node without surface on the others.
                let w = along * across.0 * across.1 + 1e-6;
                found[count] = (value, w, (off * off).min(1e30));
                count += 1;
            }
        }
        let found = &found[..count];
        // Never 0, since all nodes may be on the hit's level set.
        let around = LEVEL * found.iter().map(|&(_, w, off)| w * off).sum::<f64>() + 1e-30;
        let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
        for &(value, w, off) in found {
            let w = w / (off + around);
            (sum, weight) = (sum + w * value, weight + w);
        }
        (weight > 0.0).then(|| sum / weight)
    }

    /// The mean of the filled nodes that are fewest steps beside a cell: level sets just outside the sweep run beside
    /// its cells.
    pub(super) fn beside(&self, cell: [usize; 3]) -> Option<DVec3> {
        let lattice = self.field.lattice();
        let dims = lattice.dims();
        (1..=BESIDE).find_map(|reach| {
            let [xs, ys, zs]: [_; 3] =
                std::array::from_fn(|a| cell[a].saturating_sub(reach)..=(cell[a] + 1 + reach).min(dims[a] - 1));
            let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
            for z in zs {
                for y in ys.clone() {
                    for x in xs.clone() {
                        if let Some(value) = self.at(self.stored.slot(lattice.offset(x, y, z))) {
                            (sum, weight) = (sum + value, weight + 1.0);
                        }
                    }
                }
            }
            (weight > 0.0).then(|| sum / weight)
        })
    }
}
