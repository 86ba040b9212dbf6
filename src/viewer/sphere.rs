//! Points spread evenly over the unit sphere.

use std::collections::BTreeMap;

use nalgebra::Vector3;

/// Unit vectors, the vertices of nearly equal triangles (counter-clockwise seen from outside).
pub(super) struct Sphere {
    pub(super) vertices: Vec<Vector3<f64>>,
    triangles: Vec<[u32; 3]>,
}

impl Sphere {
    /// An icosahedron whose triangles are each divided into four, `divisions` times over:
    /// `10 * 4^divisions + 2` vertices, edges of about `63 deg / 2^divisions`.
    pub(super) fn icosahedral(divisions: u32) -> Self {
        let mut sphere = Self::icosahedron();
        for _ in 0..divisions {
            sphere.divide();
        }
        sphere
    }

    fn icosahedron() -> Self {
        let golden = 0.5 * (1.0 + 5.0_f64.sqrt());
        let corner = |a: f64, b: f64| {
            [Vector3::new(0.0, a, b), Vector3::new(a, b, 0.0), Vector3::new(b, 0.0, a)]
        };
        let corners = [(1.0, golden), (1.0, -golden), (-1.0, golden), (-1.0, -golden)];
        let vertices: Vec<_> =
            corners.into_iter().flat_map(|(a, b)| corner(a, b)).map(|v| v.normalize()).collect();
        // Corners of one triangle are neighbours of one another: the nearest.
        let neighbours = |i: usize, j: usize| vertices[i].dot(&vertices[j]) > 0.4;
        let mut triangles = Vec::new();
        for i in 0..vertices.len() {
            for j in i + 1..vertices.len() {
                for k in j + 1..vertices.len() {
                    if neighbours(i, j) && neighbours(j, k) && neighbours(i, k) {
                        let outward = vertices[i].dot(&vertices[j].cross(&vertices[k])) > 0.0;
                        let [i, j, k] = [i, j, k].map(|index| index as u32);
                        triangles.push(if outward { [i, j, k] } else { [i, k, j] });
                    }
                }
            }
        }
        Self { vertices, triangles }
    }

    fn divide(&mut self) {
        let mut middles = BTreeMap::new();
        let vertices = &mut self.vertices;
        let mut middle = |a: u32, b: u32| {
            *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                let between = (vertices[a as usize] + vertices[b as usize]).normalize();
                vertices.push(between);
                vertices.len() as u32 - 1
            })
        };
        let divide = |&[a, b, c]: &[u32; 3]| {
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        };
        self.triangles = self.triangles.iter().flat_map(divide).collect();
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn triangles_cover_the_sphere_once() {
        let sphere = Sphere::icosahedral(3);
        assert_eq!((sphere.vertices.len(), sphere.triangles.len()), (642, 1280));
        let area = |&[a, b, c]: &[u32; 3]| {
            let [a, b, c] = [a, b, c].map(|index| sphere.vertices[index as usize]);
            // Solid angle of a triangle (van Oosterom and Strackee 1983).
            let numerator = a.dot(&b.cross(&c));
            2.0 * numerator.atan2(1.0 + a.dot(&b) + b.dot(&c) + c.dot(&a))
        };
        let areas: Vec<f64> = sphere.triangles.iter().map(area).collect();
        assert!(areas.iter().all(|area| *area > 0.0));
        assert_relative_eq!(areas.iter().sum::<f64>(), 4.0 * PI, max_relative = 1e-12);
    }
}
