//! Moments of `Q` as linear functionals of twenty numbers.
//!
//! The entries of `Q` are quadratic in the unit quaternion `x`, and only even powers of each
//! component survive the expectation. So every moment of `Q` up to order three is a cubic form in
//! `y = (x0^2, x1^2, x2^2, x3^2)`, lower orders being raised by `sum y = 1`. A routine that
//! delivers the twenty cubic moments of four linear functions `z` of `y` delivers them all; which
//! `z` suits depends on the concentration ([`Basis`]). The coefficients are small dyadic
//! rationals, so changing the basis here, symbolically, leaves nothing to cancel numerically.

use std::sync::LazyLock;

/// Number of monomials of degree three in four variables.
pub(super) const CUBICS: usize = 20;
/// Number of distinct moments of `Q` up to order three, and of complements `1 - Q_ii`.
pub(super) const FORMS: usize = 50;

/// Exponents of the cubic monomials, in the order in which the routines fill them.
pub(super) const MONOMIALS: [[usize; 4]; CUBICS] = monomials();

/// Row of the form that vanishes.
const ZERO: u8 = u8::MAX;

const fn monomials() -> [[usize; 4]; CUBICS] {
    let mut list = [[0; 4]; CUBICS];
    let (mut next, mut p) = (0, 0);
    while p <= 3 {
        let mut i = 0;
        while i <= p {
            let mut j = 0;
            while j <= 3 - p {
                list[next] = [p - i, i, 3 - p - j, j];
                next += 1;
                j += 1;
            }
            i += 1;
        }
        p += 1;
    }
    list
}

/// Four linear functions of `y` whose cubic moments a routine delivers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Basis {
    /// `(1, Q11, Q22, Q33)`: keeps moments that vanish at the uniform distribution.
    Diagonal = 0,
    /// `(rho, rho cos 2 alpha, u, u cos 2 beta)` of the two circles: moments that vanish with
    /// either circle's concentration keep their digits.
    Circles = 1,
    /// `(1, x1^2, x2^2, x3^2)`: keeps the small quantities of a concentrated distribution.
    Squares = 2,
}

impl Basis {
    /// `T` with `y = T z`.
    const fn squares_from_basis(self) -> [[f64; 4]; 4] {
        match self {
            Basis::Diagonal => [
                [0.25, 0.25, 0.25, 0.25],
                [0.25, 0.25, -0.25, -0.25],
                [0.25, -0.25, 0.25, -0.25],
                [0.25, -0.25, -0.25, 0.25],
            ],
            Basis::Circles => [
                [0.5, 0.5, 0.0, 0.0],
                [0.5, -0.5, 0.0, 0.0],
                [0.0, 0.0, 0.5, 0.5],
                [0.0, 0.0, 0.5, -0.5],
            ],
            Basis::Squares => [
                [1.0, -1.0, -1.0, -1.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
            ],
        }
    }
}

type Cubic = [f64; CUBICS];

/// Values of all distinct moments, from the cubic moments of a basis.
pub(super) fn evaluate(basis: Basis, cubics: &Cubic) -> [f64; FORMS] {
    let rows = &TABLES.rows[basis as usize];
    let mut values = [0.0; FORMS];
    for (value, row) in values.iter_mut().zip(rows) {
        *value = row.iter().zip(cubics).map(|(a, b)| a * b).sum();
    }
    values
}

/// Row of `1 - Q_ii`.
pub(super) fn complement_row(i: usize) -> usize {
    i
}

/// `E[(1 - Q_ii)(1 - Q_jj)(1 - Q_kk)]` from the cubic moments of a basis.
pub(super) fn complement_product(basis: Basis, cubics: &Cubic, [i, j, k]: [usize; 3]) -> f64 {
    let row = &TABLES.complements[basis as usize][i % 3][j % 3][k % 3];
    row.iter().zip(cubics).map(|(a, b)| a * b).sum()
}

/// Row of the product of one to three entries of `Q`, each `(row, column)` from 0 to 2; `None`
/// where the moment vanishes (corollary 2.1).
pub(super) fn row(entries: &[(usize, usize)]) -> Option<usize> {
    let code = entries.iter().fold(0, |code, &(i, j)| 10 * code + 1 + (3 * i + j) % 9);
    TABLES.index.get(code).filter(|&&row| row != ZERO).map(|&row| usize::from(row))
}

struct Tables {
    rows: [[Cubic; FORMS]; 3],
    /// Row of each product, by decimal code of its entries (1 to 9 each).
    index: [u8; 1000],
    /// Products of three complements, by their indices.
    complements: [[[[Cubic; 3]; 3]; 3]; 3],
}

static TABLES: LazyLock<Tables> = LazyLock::new(Tables::new);

impl Tables {
    fn new() -> Self {
        let (forms, index) = distinct_forms();
        let bases = [Basis::Diagonal, Basis::Circles, Basis::Squares];
        let changes = bases.map(|basis| cubic_change(&basis.squares_from_basis()));
        let changed = |form: &Cubic, change: &[Cubic; CUBICS]| -> Cubic {
            std::array::from_fn(|m| (0..CUBICS).map(|y| form[y] * change[y][m]).sum())
        };
        let rows = changes.map(|change| {
            let mut rows = [[0.0; CUBICS]; FORMS];
            for (row, form) in rows.iter_mut().zip(&forms) {
                *row = changed(form, &change);
            }
            rows
        });
        let triple =
            |[i, j, k]: [usize; 3]| cubic_of(&multiply(&multiply(&small(i), &small(j)), &small(k)));
        let complements = changes.map(|change| {
            std::array::from_fn(|i| {
                std::array::from_fn(|j| {
                    std::array::from_fn(|k| changed(&triple([i, j, k]), &change))
                })
            })
        });
        Self { rows, index, complements }
    }
}

/// All forms in `y`: the complements first, then each product of entries that is new.
fn distinct_forms() -> (Vec<Cubic>, [u8; 1000]) {
    let mut forms: Vec<Cubic> = (0..3).map(complement).collect();
    let mut index = [ZERO; 1000];
    for (code, row) in index.iter_mut().enumerate() {
        let digits = [code / 100, code / 10 % 10, code % 10];
        let entries: Vec<usize> = digits.into_iter().skip_while(|&d| d == 0).collect();
        if entries.is_empty() || entries.contains(&0) {
            continue;
        }
        let form = even_part(&entries);
        if form.iter().all(|&c| c == 0.0) {
            continue;
        }
        let known = forms.iter().position(|f| *f == form);
        *row = known.unwrap_or(forms.len()) as u8;
        if known.is_none() {
            forms.push(form);
        }
    }
    (forms, index)
}

/// Coefficients of a form of degree six in `x`: `[x0][x1][x2][x3]` in base 7.
type Sextic = Vec<([usize; 4], f64)>;

/// `1 - Q_ii = 2 (sum of x_j^2 over j neither 0 nor i)`.
fn small(i: usize) -> Sextic {
    (1..4).filter(|&j| j != i + 1).map(|j| (square(j), 2.0)).collect()
}

fn complement(i: usize) -> Cubic {
    cubic_of(&multiply(&multiply(&small(i), &norm()), &norm()))
}

/// The even part of a product of entries of `Q`, each numbered from 1 to 9 by rows.
fn even_part(entries: &[usize]) -> Cubic {
    let mut product: Sextic = vec![([0; 4], 1.0)];
    for factor in 0..3 {
        let quadratic = entries.get(factor).map_or_else(norm, |e| entry((e - 1) / 3, (e - 1) % 3));
        product = multiply(&product, &quadratic);
    }
    cubic_of(&product)
}

/// `Q_ij` as a quadratic form in the unit quaternion (2.33).
fn entry(i: usize, j: usize) -> Sextic {
    if i == j {
        let sign = |a: usize| if a == 0 || a == i + 1 { 1.0 } else { -1.0 };
        return (0..4).map(|a| (square(a), sign(a))).collect();
    }
    let k = 3 - i - j;
    let cyclic = (i + 1) % 3 == j;
    let mut symmetric = [0; 4];
    symmetric[i + 1] += 1;
    symmetric[j + 1] += 1;
    let mut skew = [0; 4];
    skew[0] += 1;
    skew[k + 1] += 1;
    vec![(symmetric, 2.0), (skew, if cyclic { -2.0 } else { 2.0 })]
}

fn square(a: usize) -> [usize; 4] {
    let mut exponents = [0; 4];
    exponents[a] = 2;
    exponents
}

fn norm() -> Sextic {
    (0..4).map(|a| (square(a), 1.0)).collect()
}

fn multiply(p: &Sextic, q: &Sextic) -> Sextic {
    let product = |(a, c): &([usize; 4], f64), (b, d): &([usize; 4], f64)| {
        (std::array::from_fn(|n| a[n] + b[n]), c * d)
    };
    p.iter().flat_map(|x| q.iter().map(move |y| product(x, y))).collect()
}

fn cubic_of(sextic: &Sextic) -> Cubic {
    let mut cubic = [0.0; CUBICS];
    for (exponents, coefficient) in sextic {
        let matches = |m: &[usize; 4]| (0..4).all(|a| exponents[a] == 2 * m[a]);
        if let Some(n) = MONOMIALS.iter().position(matches) {
            cubic[n] += coefficient;
        }
    }
    cubic
}

/// `y^m = sum_n change[m][n] z^n` for the cubic monomials when `y = t z`.
fn cubic_change(t: &[[f64; 4]; 4]) -> [Cubic; CUBICS] {
    MONOMIALS.map(|monomial| {
        let mut product: Sextic = vec![([0; 4], 1.0)];
        for (a, &power) in monomial.iter().enumerate() {
            let linear: Sextic = (0..4).map(|b| (square(b), t[a][b])).collect();
            for _ in 0..power {
                product = multiply(&product, &linear);
            }
        }
        cubic_of(&product)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_as_many_forms_as_the_tables_hold() {
        assert_eq!(distinct_forms().0.len(), FORMS);
    }

    #[test]
    fn moments_with_an_odd_index_vanish() {
        assert_eq!(row(&[(0, 1)]), None);
        assert_eq!(row(&[(0, 1), (1, 2)]), None);
        assert_eq!(row(&[(0, 1), (1, 2), (0, 0)]), None);
        assert!(row(&[(0, 1), (1, 2), (2, 0)]).is_some());
        assert_eq!(row(&[(0, 1), (1, 0), (2, 2)]), row(&[(2, 2), (1, 0), (0, 1)]));
    }

    /// At a single point of the sphere the forms are products of entries of a rotation whose
    /// odd monomials cancel over the signs of `x`.
    #[test]
    fn forms_reproduce_the_entries_of_a_rotation() {
        use crate::so3::rotation_from_quaternion;
        use nalgebra::Vector4;
        let x = Vector4::new(0.7, -0.1, 0.4, 0.2).normalize();
        let signs = |n: usize| Vector4::from_fn(|a, _| if n >> a & 1 == 1 { -x[a] } else { x[a] });
        let y = x.map(|v| v * v);
        let z: [[f64; 4]; 3] = [
            [1.0, y[0] + y[1] - y[2] - y[3], y[0] + y[2] - y[1] - y[3], y[0] + y[3] - y[1] - y[2]],
            [y[0] + y[1], y[0] - y[1], y[2] + y[3], y[2] - y[3]],
            [1.0, y[1], y[2], y[3]],
        ];
        for (basis, z) in [Basis::Diagonal, Basis::Circles, Basis::Squares].into_iter().zip(z) {
            let cubics = MONOMIALS.map(|m| (0..4).map(|a| z[a].powi(m[a] as i32)).product::<f64>());
            let values = evaluate(basis, &cubics);
            for code in 0..729 {
                let entries = [code / 81, code / 9 % 9, code % 9].map(|e| (e / 3, e % 3));
                let mean: f64 = (0..16)
                    .map(|n| {
                        let q = rotation_from_quaternion(&signs(n));
                        entries.iter().map(|&e| q[e]).product::<f64>() / 16.0
                    })
                    .sum();
                let found = row(&entries).map_or(0.0, |r| values[r]);
                assert!((found - mean).abs() < 1e-14, "{entries:?} {found} {mean}");
            }
        }
    }
}
