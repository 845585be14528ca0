//! Cells by what their corners span.

use super::Field;
use rayon::prelude::*;

impl Field {
    /// Numbers of the cells, x fastest, that level sets of the sweep pass: a constant cell holds none.
    pub fn cells_on_sweep(&self) -> Vec<usize> {
        let passed = |&cell: &usize| {
            let [lo, hi] = self.cell_range(cell);
            lo <= 1.0 && hi >= 0.0 && lo < hi
        };
        (0..self.lattice().cells().iter().product()).into_par_iter().filter(passed).collect()
    }

    /// The first corner of a cell.
    pub fn cell_corner(&self, cell: usize) -> [usize; 3] {
        let [nx, ny, _] = self.lattice().cells();
        [cell % nx, cell / nx % ny, cell / (nx * ny)]
    }

    /// Least and greatest h of a cell, units of the sweep.
    pub fn cell_range(&self, cell: usize) -> [f32; 2] {
        let corners = self.corners(self.cell_corner(cell));
        corners.into_iter().fold([f32::INFINITY, f32::NEG_INFINITY], |[lo, hi], h| [lo.min(h), hi.max(h)])
    }

    /// About the share of Ω that level sets of the sweep fill: of each cell as much as of its range.
    pub fn share_on_sweep(&self) -> f64 {
        let cells = self.lattice().cells().iter().product();
        let share = |cell: usize| {
            let [lo, hi] = self.cell_range(cell).map(f64::from);
            match lo < hi {
                true => ((hi.min(1.0) - lo.max(0.0)) / (hi - lo)).max(0.0),
                false => f64::from((0.0..=1.0).contains(&lo)),
            }
        };
        // In parts of fixed size, added in their order.
        let parts = (0..cells).into_par_iter().fold_chunks(1 << 14, || 0.0, |sum, cell| sum + share(cell));
        parts.collect::<Vec<f64>>().into_iter().sum::<f64>() / cells as f64
    }
}
