//! The points of a lattice that share a cell with one of them, itself included.

use std::ops::Range;

/// Runs of memory, in its order, that hold the neighbourhood of point `at` of a lattice, x fastest.
#[inline]
pub(crate) fn neighbourhood(dims: [usize; 3], at: usize) -> impl Iterator<Item = Range<usize>> {
    within(dims, at, 1)
}

/// Runs of memory, in its order, that hold the points of a lattice within so many steps of point `at` along every axis.
#[inline]
pub(crate) fn within([nx, ny, nz]: [usize; 3], at: usize, steps: usize) -> impl Iterator<Item = Range<usize>> {
    let beside = move |i: usize, n: usize| i.saturating_sub(steps)..(i + steps + 1).min(n);
    let (x, y, z) = (beside(at % nx, nx), beside(at / nx % ny, ny), beside(at / (nx * ny), nz));
    z.flat_map(move |z| {
        let x = x.clone();
        y.clone().map(move |y| (z * ny + y) * nx).map(move |row| row + x.start..row + x.end)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_point_within_some_steps_once_and_in_order() {
        for dims in [[5, 4, 3], [2, 2, 2], [1, 3, 1]] {
            let [nx, ny, nz] = dims;
            let place = |o: usize| [o % nx, o / nx % ny, o / (nx * ny)];
            let all = 0..nx * ny * nz;
            for at in all.clone() {
                let near = |steps: usize| -> Vec<usize> {
                    all.clone().filter(|o| (0..3).all(|a| place(*o)[a].abs_diff(place(at)[a]) <= steps)).collect()
                };
                assert_eq!(neighbourhood(dims, at).flatten().collect::<Vec<_>>(), near(1), "{dims:?}: {at}");
                assert_eq!(within(dims, at, 2).flatten().collect::<Vec<_>>(), near(2), "{dims:?}: {at}");
            }
        }
    }
}
