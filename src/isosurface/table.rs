//! The 256 cases of marching cubes, derived from one rule instead of listed.
//!
//! Corner x + 2y + 4z of a cell is bit x + 2y + 4z of its case, set if the corner is inside (h ≥ c). On every face, the
//! inside corners that are not joined by an edge of the face are **separated**. Two cells that share a face see the
//! same four corners, hence draw the same segments on it, and the mesh closes. The rule is also that of VTK's tables.

use std::sync::LazyLock;

/// End corners of the 12 edges of a cell, lower one first. Edges 0–3 run along x, at (y, z) = (0,0), (1,0), (0,1),
/// (1,1); edges 4–7 along y, at (x, z) likewise; edges 8–11 along z, at (x, y) likewise.
pub(super) const EDGES: [[u8; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

/// Corners of the 6 faces (x = 0, x = 1, y = 0 …), counter-clockwise as seen from outside the cell.
const FACES: [[u8; 4]; 6] = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// The triangles of one case, as edges of the cell. Seen from the lower side they turn counter-clockwise.
#[derive(Clone, Debug)]
pub(super) struct Case {
    triangles: [[u8; 3]; MAX_TRIANGLES],
    count: u8,
}

/// No case has more triangles (asserted while the table is built).
const MAX_TRIANGLES: usize = 5;

impl Case {
    /// The triangles.
    #[inline]
    pub(super) fn triangles(&self) -> &[[u8; 3]] {
        &self.triangles[..self.count as usize]
    }
}

/// The cases by their corner bits.
pub(super) static CASES: LazyLock<Vec<Case>> = LazyLock::new(|| (0..=255).map(case).collect());

/// Builds one case.
fn case(bits: u8) -> Case {
    let mut result = Case { triangles: [[0; 3]; MAX_TRIANGLES], count: 0 };
    for polygon in polygons(bits) {
        let (_, triangles) = triangulate(&polygon).expect("every loop has a triangulation without face diagonals");
        for triangle in triangles {
            result.triangles[result.count as usize] = triangle;
            result.count += 1;
        }
    }
    result
}

/// The edge of the cell between two of its corners.
fn edge_between(a: u8, b: u8) -> u8 {
    EDGES.iter().position(|e| *e == [a.min(b), a.max(b)]).expect("the corners of a face are joined by edges") as u8
}

/// The closed loops in which the level set meets the cell's faces, each a cycle of crossed edges.
///
/// Around a face, runs of inside corners alternate with outside ones. A run is cut off by one segment, from the edge
/// where the run begins to the edge where it ends. A crossed edge belongs to two faces, which turn around it in
/// opposite senses: it begins a run in one and ends a run in the other, so the segments join up to oriented loops.
pub(super) fn polygons(bits: u8) -> Vec<Vec<u8>> {
    let inside = |corner: u8| bits >> corner & 1 == 1;
    let mut next = [None; 12];
    for face in FACES {
        for begin in 0..4 {
            if !inside(face[begin]) && inside(face[(begin + 1) % 4]) {
                let mut end = begin + 1;
                while inside(face[(end + 1) % 4]) {
                    end += 1;
                }
                let from = edge_between(face[begin], face[(begin + 1) % 4]);
                next[from as usize] = Some(edge_between(face[end % 4], face[(end + 1) % 4]));
            }
        }
    }
    let mut polygons = Vec::new();
    for start in 0..12 {
        let mut polygon = Vec::new();
        let mut edge = start as u8;
        while let Some(following) = next[edge as usize].take() {
            polygon.push(edge);
            edge = following;
        }
        if !polygon.is_empty() {
            polygons.push(polygon);
        }
    }
    polygons
}

/// Whether two edges of the cell lie in a common face.
fn share_face(a: u8, b: u8) -> bool {
    let on = |face: &[u8; 4], e: u8| EDGES[e as usize].iter().all(|corner| face.contains(corner));
    FACES.iter().any(|face| on(face, a) && on(face, b))
}

/// Squared distance of two edges' midpoints, in half cells.
fn distance(a: u8, b: u8) -> u32 {
    let middle = |e: u8| [0, 1, 2].map(|axis| EDGES[e as usize].iter().map(|c| (c >> axis & 1) as i32).sum::<i32>());
    (0..3).map(|axis| (middle(a)[axis] - middle(b)[axis]).pow(2) as u32).sum()
}

/// Triangulates a loop with the shortest diagonals (by squared length, summed) that stay off the cell's faces.
///
/// A diagonal in a face could be chosen by the neighbouring cell as well: that edge would belong to four triangles. All
/// other diagonals lie inside the cell and belong to exactly two.
fn triangulate(polygon: &[u8]) -> Option<(u32, Vec<[u8; 3]>)> {
    let n = polygon.len();
    if n < 3 {
        return Some((0, Vec::new()));
    }
    // The side from the last to the first vertex belongs to one triangle; its apex splits the rest in two.
    let mut best = None;
    for apex in 1..n - 1 {
        let (left, right) = (&polygon[..=apex], &polygon[apex..]);
        let mut cost = 0;
        let mut allowed = true;
        for (part, a, b) in [(left, polygon[0], polygon[apex]), (right, polygon[apex], polygon[n - 1])] {
            if part.len() > 2 {
                allowed &= !share_face(a, b);
                cost += distance(a, b);
            }
        }
        if !allowed {
            continue;
        }
        let (Some((cost_left, left)), Some((cost_right, right))) = (triangulate(left), triangulate(right)) else {
            continue;
        };
        let cost = cost + cost_left + cost_right;
        if best.as_ref().is_none_or(|(least, _)| cost < *least) {
            let mut triangles = vec![[polygon[0], polygon[apex], polygon[n - 1]]];
            triangles.extend(left);
            triangles.extend(right);
            best = Some((cost, triangles));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// Directed sides of a case's triangles, with how often each occurs.
    fn sides(bits: u8) -> BTreeMap<(u8, u8), u32> {
        let mut sides = BTreeMap::new();
        for t in CASES[bits as usize].triangles() {
            for i in 0..3 {
                *sides.entry((t[i], t[(i + 1) % 3])).or_default() += 1;
            }
        }
        sides
    }

    /// The sides that have no opposite within the cell: its outline.
    fn outline(bits: u8) -> Vec<(u8, u8)> {
        let sides = sides(bits);
        sides.keys().filter(|(a, b)| !sides.contains_key(&(*b, *a))).copied().collect()
    }

    #[test]
    fn every_crossed_edge_and_only_those_are_used() {
        for bits in 0..=255u8 {
            let mut used = [false; 12];
            CASES[bits as usize].triangles().iter().flatten().for_each(|e| used[*e as usize] = true);
            for (e, [a, b]) in EDGES.iter().enumerate() {
                assert_eq!(used[e], (bits >> a & 1) != (bits >> b & 1), "case {bits}, edge {e}");
            }
        }
    }

    #[test]
    fn each_case_is_a_set_of_oriented_discs_that_end_on_the_faces() {
        for bits in 0..=255u8 {
            assert!(sides(bits).values().all(|n| *n == 1), "case {bits}: a side twice in the same sense");
            let outline = outline(bits);
            // Within the cell's faces run the outline's sides only, so no neighbour can double a diagonal.
            for &(a, b) in sides(bits).keys() {
                assert_eq!(share_face(a, b), outline.contains(&(a, b)), "case {bits}: side {a}-{b}");
            }
            // Discs: V − E + F = 1 each.
            let vertices = outline.len();
            let edges = (sides(bits).len() + outline.len()) / 2;
            let faces = CASES[bits as usize].triangles().len();
            assert_eq!(vertices + faces, edges + polygons(bits).len(), "case {bits}");
        }
    }

    /// All pairs of configurations of two cells that share a face, for the three axes: what one cell's triangles leave
    /// open on the face is what the other's close, in the opposite sense.
    #[test]
    fn neighbours_agree_on_their_common_face() {
        for axis in 0..3 {
            let bit = 1u8 << axis;
            let mirrored = |e: u8| {
                let [a, b] = EDGES[e as usize];
                edge_between(a ^ bit, b ^ bit)
            };
            let on_face = |high: bool, e: u8| EDGES[e as usize].iter().all(|c| (c & bit != 0) == high);
            let mut pairs = 0;
            for low in 0..=255u8 {
                let mut right: Vec<_> =
                    outline(low).into_iter().filter(|&(a, b)| on_face(true, a) && on_face(true, b)).collect();
                right.sort_unstable();
                for high in 0..=255u8 {
                    let same = (0..8).filter(|c| c & bit != 0).all(|c| (low >> c & 1) == (high >> (c ^ bit) & 1));
                    if !same {
                        continue;
                    }
                    pairs += 1;
                    let mut left: Vec<_> = outline(high)
                        .into_iter()
                        .filter(|&(a, b)| on_face(false, a) && on_face(false, b))
                        .map(|(a, b)| (mirrored(b), mirrored(a)))
                        .collect();
                    left.sort_unstable();
                    assert_eq!(left, right, "axis {axis}, cases {low} and {high}");
                }
            }
            assert_eq!(pairs, 4096, "12 corners in two states");
        }
    }

    #[test]
    fn a_lone_inside_corner_faces_outward() {
        // Corner 0 inside: the triangle's normal points to (1, 1, 1), so x → y → z.
        let t = CASES[1].triangles();
        assert_eq!(t.len(), 1);
        let turned = [[0, 4, 8], [4, 8, 0], [8, 0, 4]];
        assert!(turned.contains(&t[0]), "{t:?}");
    }

    #[test]
    fn diagonal_inside_corners_of_a_face_are_separated() {
        assert_eq!(polygons(0b0000_1001).len(), 2, "corners 0 and 3");
        assert_eq!(polygons(0b0110_1001).len(), 4, "four corners, no two joined by an edge");
    }
}
