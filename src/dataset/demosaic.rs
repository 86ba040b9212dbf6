//! Images of which not every pixel holds every color: Bayer mosaics and YUV with shared chroma.

use super::encoding::{BayerPattern, YuvOrder};

/// RGB from a Bayer mosaic, rows without padding, by bilinear interpolation: a missing color is the
/// mean of its nearest neighbours. At the border the mosaic is continued by reflection, which keeps
/// its pattern.
///
/// `data` holds `width * height` values, both at least 1.
pub(super) fn bayer_to_rgb(
    data: &[u8],
    (width, height): (usize, usize),
    first: BayerPattern,
) -> Vec<u8> {
    // Position of red in the pattern; blue is diagonally opposite.
    let (red_column, red_row) = match first {
        BayerPattern::Rggb => (0, 0),
        BayerPattern::Grbg => (1, 0),
        BayerPattern::Gbrg => (0, 1),
        BayerPattern::Bggr => (1, 1),
    };
    let mut rgb = Vec::with_capacity(3 * data.len());
    for row in 0..height {
        let rows = [reflected(row, -1, height), row, reflected(row, 1, height)];
        for column in 0..width {
            let columns = [reflected(column, -1, width), column, reflected(column, 1, width)];
            let at = |r: usize, c: usize| u16::from(data[rows[r] * width + columns[c]]);
            let own = at(1, 1);
            let across = (at(1, 0) + at(1, 2)).div_ceil(2);
            let down = (at(0, 1) + at(2, 1)).div_ceil(2);
            let cross = (at(1, 0) + at(1, 2) + at(0, 1) + at(2, 1) + 2) / 4;
            let diagonal = (at(0, 0) + at(0, 2) + at(2, 0) + at(2, 2) + 2) / 4;
            let on_red_row = row % 2 == red_row;
            let on_red_column = column % 2 == red_column;
            let pixel = match (on_red_row, on_red_column) {
                (true, true) => [own, cross, diagonal],
                (true, false) => [across, own, down],
                (false, true) => [down, own, across],
                (false, false) => [diagonal, cross, own],
            };
            rgb.extend(pixel.map(|value| value as u8));
        }
    }
    rgb
}

/// The neighbour of `index`, or the one on the other side where there is none.
fn reflected(index: usize, step: isize, count: usize) -> usize {
    let inside = |step| index.checked_add_signed(step).filter(|neighbour| *neighbour < count);
    inside(step).or_else(|| inside(-step)).unwrap_or(index)
}

/// RGB from luminance and chroma of ITU-R BT.601 with 16 to 235 for black to white.
fn yuv_to_rgb(y: u8, u: u8, v: u8) -> [u8; 3] {
    // Blacker than black is black.
    let grey = 1.164 * (f32::from(y) - 16.0).max(0.0);
    let (u, v) = (f32::from(u) - 128.0, f32::from(v) - 128.0);
    let to_byte = |value: f32| value.round().clamp(0.0, 255.0) as u8;
    [grey + 1.596 * v, grey - 0.813 * v - 0.391 * u, grey + 2.018 * u].map(to_byte)
}

/// RGB from pairs of pixels that share their chroma: `data` holds an even number of pixels of two
/// bytes.
pub(super) fn yuv422_to_rgb(data: &[u8], order: YuvOrder) -> Vec<u8> {
    let mut rgb = Vec::with_capacity(data.len() / 2 * 3);
    for pair in data.as_chunks::<4>().0 {
        let [u, first, v, second] = match order {
            YuvOrder::Uyvy => *pair,
            YuvOrder::Yuyv => [pair[1], pair[0], pair[3], pair[2]],
        };
        rgb.extend(yuv_to_rgb(first, u, v));
        rgb.extend(yuv_to_rgb(second, u, v));
    }
    rgb
}

/// RGB from a plane of luminance and one of chroma pairs for every two by two pixels; `width` and
/// the height are even.
pub(super) fn yuv420_to_rgb(
    luminance: &[u8],
    chroma: &[u8],
    width: usize,
    u_first: bool,
) -> Vec<u8> {
    let mut rgb = Vec::with_capacity(3 * luminance.len());
    for (row, line) in luminance.chunks_exact(width).enumerate() {
        let pairs = &chroma[row / 2 * width..][..width];
        for (column, y) in line.iter().enumerate() {
            let pair = &pairs[column / 2 * 2..];
            let (u, v) = if u_first { (pair[0], pair[1]) } else { (pair[1], pair[0]) };
            rgb.extend(yuv_to_rgb(*y, u, v));
        }
    }
    rgb
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Random values, and what OpenCV 5.0.0's `cvtColor` makes of them.
    const MOSAIC: [u8; 36] = [
        139, 74, 229, 241, 169, 65, 6, 160, 149, 106, 38, 175, 188, 205, 175, 229, 98, 249, 10,
        148, 95, 86, 147, 198, 66, 39, 106, 213, 171, 45, 167, 57, 69, 81, 55, 14,
    ];
    /// Without the border, which OpenCV fills otherwise.
    const DEMOSAICED: [(BayerPattern, [u8; 48]); 4] = [
        (
            BayerPattern::Rggb,
            [
                183, 109, 160, 202, 149, 133, 168, 164, 106, 134, 38, 141, 182, 205, 154, 175, 170,
                125, 137, 229, 96, 98, 166, 141, 134, 87, 148, 141, 95, 117, 138, 171, 86, 135,
                147, 142, 86, 39, 103, 106, 104, 93, 139, 213, 84, 171, 115, 95,
            ],
        ),
        (
            BayerPattern::Bggr,
            [
                160, 109, 183, 133, 149, 202, 106, 164, 168, 141, 38, 134, 154, 205, 182, 125, 170,
                175, 96, 229, 137, 141, 166, 98, 148, 87, 134, 117, 95, 141, 86, 171, 138, 142,
                147, 135, 103, 39, 86, 93, 104, 106, 84, 213, 139, 95, 115, 171,
            ],
        ),
        (
            BayerPattern::Gbrg,
            [
                78, 160, 140, 149, 168, 187, 94, 106, 235, 38, 137, 196, 65, 168, 205, 122, 175,
                217, 107, 116, 229, 93, 98, 239, 53, 148, 122, 95, 129, 172, 121, 86, 221, 147,
                138, 184, 85, 94, 39, 82, 106, 126, 92, 111, 213, 101, 171, 129,
            ],
        ),
        (
            BayerPattern::Grbg,
            [
                140, 160, 78, 187, 168, 149, 235, 106, 94, 196, 137, 38, 205, 168, 65, 217, 175,
                122, 229, 116, 107, 239, 98, 93, 122, 148, 53, 172, 129, 95, 221, 86, 121, 184,
                138, 147, 39, 94, 85, 126, 106, 82, 213, 111, 92, 129, 171, 101,
            ],
        ),
    ];

    #[test]
    fn mosaics_become_what_opencv_makes_of_them() {
        for (pattern, expected) in DEMOSAICED {
            let rgb = bayer_to_rgb(&MOSAIC, (6, 6), pattern);
            let inside = (1..5).flat_map(|row| &rgb[3 * (6 * row + 1)..3 * (6 * row + 5)]);
            assert!(inside.eq(&expected), "{pattern:?}");
        }
    }

    #[test]
    fn a_mosaic_of_one_color_is_that_color_up_to_its_border() {
        for (pattern, [first, second, third, fourth]) in [
            (BayerPattern::Rggb, [200, 100, 100, 50]),
            (BayerPattern::Bggr, [50, 100, 100, 200]),
            (BayerPattern::Gbrg, [100, 50, 200, 100]),
            (BayerPattern::Grbg, [100, 200, 50, 100]),
        ] {
            let rows =
                [[first, second, first, second, first], [third, fourth, third, fourth, third]];
            let data: Vec<u8> = (0..3).flat_map(|row| rows[row % 2]).collect();
            let rgb = bayer_to_rgb(&data, (5, 3), pattern);
            assert!(rgb.chunks(3).all(|pixel| pixel == [200, 100, 50]), "{pattern:?}: {rgb:?}");
        }
        assert_eq!(bayer_to_rgb(&[7], (1, 1), BayerPattern::Rggb), [7, 7, 7]);
    }

    fn check(computed: &[u8], opencv: &[u8]) {
        assert_eq!(computed.len(), opencv.len());
        // OpenCV rounds its coefficients to integers.
        let close = |(a, b): (&u8, &u8)| a.abs_diff(*b) <= 1;
        assert!(computed.iter().zip(opencv).all(close), "{computed:?} {opencv:?}");
    }

    #[test]
    fn yuv_becomes_what_opencv_makes_of_it() {
        let packed = [153, 178, 215, 76, 52, 39, 250, 72, 215, 50, 161, 223, 112, 172, 161, 233];
        let uyvy = [
            255, 108, 239, 209, 0, 120, 221, 0, 0, 255, 0, 0, 92, 0, 215, 255, 180, 255, 234, 161,
            149, 255, 232, 220,
        ];
        let yuyv = [
            76, 182, 255, 149, 254, 255, 0, 122, 0, 183, 255, 93, 255, 185, 74, 255, 122, 11, 255,
            9, 201, 255, 66, 255,
        ];
        check(&yuv422_to_rgb(&packed, YuvOrder::Uyvy), &uyvy);
        check(&yuv422_to_rgb(&packed, YuvOrder::Yuyv), &yuyv);
        let luminance = [94, 25, 166, 33, 249, 189, 12, 204, 33, 57, 124, 30, 199, 149, 202, 119];
        let chroma = [72, 220, 3, 209, 122, 136, 147, 77];
        let nv12 = [
            238, 38, 0, 157, 0, 0, 255, 158, 0, 149, 3, 0, 255, 218, 158, 255, 148, 88, 129, 0, 0,
            255, 202, 0, 33, 16, 8, 60, 44, 36, 44, 160, 164, 0, 50, 55, 226, 209, 201, 168, 151,
            143, 135, 251, 255, 38, 154, 158,
        ];
        let nv21 = [
            1, 100, 255, 0, 20, 196, 0, 245, 255, 0, 90, 183, 182, 255, 255, 112, 211, 255, 0, 70,
            163, 19, 255, 255, 10, 22, 36, 38, 49, 64, 156, 130, 23, 47, 21, 0, 203, 215, 229, 145,
            157, 171, 247, 221, 114, 150, 124, 17,
        ];
        check(&yuv420_to_rgb(&luminance, &chroma, 4, true), &nv12);
        check(&yuv420_to_rgb(&luminance, &chroma, 4, false), &nv21);
    }
}
