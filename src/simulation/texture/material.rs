//! What the faces of the world are made of.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::canvas::{Area, Canvas, Leaves, Palette, from_hsv, power_law_radius};
use super::{Color, Picture, Texture};

/// What a face is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Material {
    /// Painted plaster with posters, notices and pictures.
    Wall,
    /// Suspended panels with lamps.
    Ceiling,
    /// Planks with rugs and stains.
    Floor,
    /// Cardboard with tape, labels and print.
    Carton,
    /// Grained wood, with drawers.
    Wood,
    /// Rows of book spines.
    Books,
    /// A busy print: cloth, pictures, screens.
    Print,
}

impl Material {
    /// Contrast of the fine grain laid over it, 0 to 1.
    pub fn grain_depth(self) -> f32 {
        match self {
            Self::Wall | Self::Ceiling => 0.12,
            Self::Books | Self::Print => 0.2,
            Self::Floor | Self::Carton | Self::Wood => 0.3,
        }
    }
}

/// Paints one face of `width` by `height` metres; `richness` from 0 (bare) to 1 (busy); pictures
/// are invented where none are given. Texels of
/// large faces have an edge of `texel` m (more beyond 16 million of them), those of small ones down
/// to half of it.
pub fn paint(
    material: Material,
    [width, height]: [f32; 2],
    texel: f32,
    richness: f32,
    pictures: &[Picture],
    rng: &mut ChaCha8Rng,
) -> Texture {
    const MAX_TEXELS: f32 = 16e6;
    let side = (width * height).sqrt();
    let texel = (side / 700.0).clamp(0.5 * texel, texel).max(side / MAX_TEXELS.sqrt());
    let columns = (width / texel).ceil().max(1.0) as usize;
    let rows = (height / texel).ceil().max(1.0) as usize;
    let mut canvas = Canvas { pictures, ..Canvas::new(columns, rows, texel, [128.0; 3]) };
    match material {
        Material::Wall => wall(&mut canvas, rng, richness),
        Material::Ceiling => ceiling(&mut canvas, rng),
        Material::Floor => floor(&mut canvas, rng, richness),
        Material::Carton => carton(&mut canvas, rng, richness),
        Material::Wood => wood(&mut canvas, rng, richness),
        Material::Books => books(&mut canvas, rng),
        Material::Print => {
            let whole = canvas.whole();
            picture(&mut canvas, rng, whole);
        }
    }
    canvas.finish()
}

fn wall(canvas: &mut Canvas, rng: &mut ChaCha8Rng, richness: f32) {
    let whole = canvas.whole();
    let tint = from_hsv(rng.random(), rng.random_range(0.03..0.2), rng.random_range(165.0..225.0));
    canvas.area(whole, tint, 1.0);
    let marks = Leaves {
        min_radius: 0.006,
        max_radius: 0.35,
        coverage: 0.35 * richness,
        opacity: 0.16,
        palette: Palette::around(rng, 5, 60.0, 240.0),
    };
    canvas.leaves(rng, whole, &marks);
    canvas.grain(rng, 0.8, 1.0, 0.05);
    if whole.width > 2.0 && whole.height > 2.2 {
        door(canvas, rng);
        window(canvas, rng);
    }
    let hung = (richness * 1.8 * whole.width * whole.height) as usize;
    for _ in 0..hung {
        let w = power_law_radius(rng, 0.18, 1.3).min(0.7 * whole.width);
        let h = (w * rng.random_range(0.6..1.5)).min(0.7 * whole.height);
        let area = Area {
            x: rng.random::<f32>() * (whole.width - w),
            y: rng.random::<f32>() * (whole.height - h),
            width: w,
            height: h,
        };
        canvas.area(Area { x: area.x + 0.012, y: area.y - 0.012, ..area }, [70.0; 3], 0.35);
        sheet(canvas, rng, area);
    }
}

fn door(canvas: &mut Canvas, rng: &mut ChaCha8Rng) {
    let x = rng.random_range(0.1..canvas.width() - 1.1);
    let leaf = Area { x, y: 0.0, width: 0.95, height: 2.05 };
    canvas.area(leaf, [225.0, 222.0, 215.0], 1.0);
    let paint = from_hsv(rng.random(), 0.35, rng.random_range(60.0..130.0));
    canvas.area(Area { x: x + 0.06, width: 0.83, height: 1.99, ..leaf }, paint, 1.0);
    for y in [0.15, 1.1] {
        let panel = Area { x: x + 0.18, y, width: 0.59, height: 0.8 };
        canvas.area(panel, paint.map(|c| 0.7 * c), 1.0);
        canvas.area(panel.inset(0.015), paint.map(|c| 1.15 * c), 1.0);
    }
    canvas.area(Area { x: x + 0.8, y: 1.0, width: 0.06, height: 0.1 }, [235.0; 3], 1.0);
}

/// Six bright panes, a little different each.
fn window(canvas: &mut Canvas, rng: &mut ChaCha8Rng) {
    let x = rng.random_range(0.1..canvas.width() - 1.5);
    let frame = Area { x, y: 0.95, width: 1.4, height: 1.1 };
    canvas.area(frame, [120.0, 112.0, 104.0], 1.0);
    for i in 0..3 {
        for j in 0..2 {
            let pane = Area {
                x: x + 0.04 + 0.445 * i as f32,
                y: 0.99 + 0.525 * j as f32,
                width: 0.42,
                height: 0.5,
            };
            canvas.area(pane, [rng.random_range(225.0..255.0); 3], 1.0);
        }
    }
}

/// A framed picture, a notice or a poster.
fn sheet(canvas: &mut Canvas, rng: &mut ChaCha8Rng, area: Area) {
    let frame = from_hsv(rng.random(), rng.random_range(0.0..0.5), rng.random_range(30.0..240.0));
    canvas.area(area, frame, 1.0);
    let inner = area.inset(rng.random_range(0.008..0.03));
    if inner.width < 0.6 && rng.random::<f32>() < 0.5 {
        canvas.area(inner, [rng.random_range(200.0..245.0); 3], 1.0);
        let ink = from_hsv(rng.random(), 0.5, rng.random_range(20.0..110.0));
        let height = rng.random_range(0.012..0.05_f32).min(inner.height / 3.0);
        canvas.print(rng, inner.inset(0.02), height, ink);
    } else {
        picture(canvas, rng, inner);
    }
}

fn picture(canvas: &mut Canvas, rng: &mut ChaCha8Rng, area: Area) {
    if !canvas.pictures.is_empty() {
        let chosen = &canvas.pictures[rng.random_range(0..canvas.pictures.len())];
        return canvas.hang(chosen, area);
    }
    let dark = rng.random_range(10.0..80.0);
    let light = rng.random_range(180.0..255.0);
    let palette = Palette::around(rng, 7, dark, light);
    canvas.area(area, palette.pick(rng), 1.0);
    let largest = 0.45 * area.width.max(area.height);
    let pattern =
        Leaves { min_radius: 0.005, max_radius: largest, coverage: 2.2, opacity: 0.95, palette };
    canvas.leaves(rng, area, &pattern);
}

fn ceiling(canvas: &mut Canvas, rng: &mut ChaCha8Rng) {
    let whole = canvas.whole();
    canvas.area(whole, [190.0, 190.0, 186.0], 1.0);
    let speckle = Leaves {
        min_radius: 0.004,
        max_radius: 0.05,
        coverage: 0.25,
        opacity: 0.3,
        palette: Palette(vec![[150.0; 3], [120.0; 3], [215.0; 3]]),
    };
    canvas.leaves(rng, whole, &speckle);
    let step = 0.6;
    for i in 0..(whole.width / step) as usize + 1 {
        for j in 0..(whole.height / step) as usize + 1 {
            let area = Area { x: i as f32 * step, y: j as f32 * step, width: step, height: step };
            match rng.random_range(0..12) {
                0 => canvas.area(area.inset(0.03), [253.0; 3], 1.0),
                1 => grille(canvas, area.inset(0.08)),
                _ => canvas.area(area, [rng.random_range(150.0..230.0); 3], 0.25),
            }
        }
    }
    lattice(canvas, step, 0.012, [110.0; 3]);
}

fn grille(canvas: &mut Canvas, area: Area) {
    canvas.area(area, [90.0; 3], 1.0);
    let slats = (area.height / 0.04) as usize;
    for k in 0..slats {
        let y = area.y + k as f32 * 0.04;
        canvas.area(Area { y, height: 0.016, ..area }, [205.0; 3], 1.0);
    }
}

fn lattice(canvas: &mut Canvas, step: f32, thickness: f32, color: Color) {
    let whole = canvas.whole();
    for i in 0..(whole.width / step) as usize + 1 {
        let x = i as f32 * step - thickness / 2.0;
        canvas.area(Area { x, width: thickness, ..whole }, color, 1.0);
    }
    for j in 0..(whole.height / step) as usize + 1 {
        let y = j as f32 * step - thickness / 2.0;
        canvas.area(Area { y, height: thickness, ..whole }, color, 1.0);
    }
}

fn floor(canvas: &mut Canvas, rng: &mut ChaCha8Rng, richness: f32) {
    let whole = canvas.whole();
    let hue = rng.random_range(0.05..0.11);
    let board = 0.14;
    for row in 0..(whole.height / board) as usize + 1 {
        let mut x = -rng.random::<f32>();
        while x < whole.width {
            let length = rng.random_range(0.5..1.3);
            let tone = from_hsv(hue, 0.4, rng.random_range(115.0..185.0));
            let area = Area { x, y: row as f32 * board, width: length, height: board };
            canvas.area(area, [55.0, 42.0, 34.0], 1.0);
            canvas.area(area.inset(0.003), tone, 1.0);
            x += length;
        }
    }
    canvas.grain(rng, 0.08, 8.0, 0.14);
    let rugs = (richness * whole.width * whole.height / 9.0) as usize;
    for _ in 0..rugs {
        let (w, h) = (rng.random_range(0.8..2.2), rng.random_range(0.6..1.6));
        let area = Area {
            x: rng.random::<f32>() * (whole.width - w).max(0.0),
            y: rng.random::<f32>() * (whole.height - h).max(0.0),
            width: w,
            height: h,
        };
        picture(canvas, rng, area);
    }
    let stains = Leaves {
        min_radius: 0.004,
        max_radius: 0.12,
        coverage: 0.25 * richness,
        opacity: 0.45,
        palette: Palette::around(rng, 6, 30.0, 220.0),
    };
    canvas.leaves(rng, whole, &stains);
}

fn carton(canvas: &mut Canvas, rng: &mut ChaCha8Rng, richness: f32) {
    let whole = canvas.whole();
    let base = from_hsv(rng.random_range(0.06..0.1), 0.42, rng.random_range(150.0..200.0));
    canvas.area(whole, base, 1.0);
    let scuffs = Leaves {
        min_radius: 0.003,
        max_radius: 0.08,
        coverage: 0.5 * richness,
        opacity: 0.3,
        palette: Palette::around(rng, 4, 50.0, 220.0),
    };
    canvas.leaves(rng, whole, &scuffs);
    canvas.grain(rng, 0.1, 1.0, 0.08);
    let tape = Area { y: 0.45 * whole.height, height: 0.05, ..whole };
    canvas.area(tape, [205.0, 190.0, 150.0], 0.7);
    for _ in 0..rng.random_range(1..4) {
        let w = rng.random_range(0.2..0.6) * whole.width;
        let h = rng.random_range(0.2..0.5) * whole.height;
        let area = Area {
            x: rng.random::<f32>() * (whole.width - w),
            y: rng.random::<f32>() * (whole.height - h),
            width: w,
            height: h,
        };
        sheet(canvas, rng, area);
    }
}

fn wood(canvas: &mut Canvas, rng: &mut ChaCha8Rng, richness: f32) {
    let whole = canvas.whole();
    let hue = rng.random_range(0.04..0.12);
    canvas.area(whole, from_hsv(hue, 0.45, rng.random_range(90.0..190.0)), 1.0);
    canvas.grain(rng, 0.05, 10.0, 0.2);
    let drawers = (whole.height / 0.3) as usize;
    for k in 0..drawers {
        let y = k as f32 * whole.height / drawers as f32;
        let area = Area { y, height: whole.height / drawers as f32, ..whole };
        canvas.area(Area { height: 0.008, ..area }, [40.0, 30.0, 24.0], 1.0);
        let handle = Area {
            x: 0.4 * whole.width,
            y: y + 0.45 * area.height,
            width: 0.2 * whole.width,
            height: 0.02,
        };
        canvas.area(handle, [215.0; 3], 1.0);
    }
    let marks = Leaves {
        min_radius: 0.003,
        max_radius: 0.1,
        coverage: 0.3 * richness,
        opacity: 0.5,
        palette: Palette::around(rng, 5, 30.0, 230.0),
    };
    canvas.leaves(rng, whole, &marks);
}

fn books(canvas: &mut Canvas, rng: &mut ChaCha8Rng) {
    let whole = canvas.whole();
    canvas.area(whole, [60.0, 46.0, 36.0], 1.0);
    let shelves = ((whole.height / 0.34) as usize).max(1);
    let pitch = whole.height / shelves as f32;
    for shelf in 0..shelves {
        let bottom = shelf as f32 * pitch + 0.025;
        let mut x = 0.02;
        while x < whole.width - 0.03 {
            let thickness = rng.random_range(0.015..0.06_f32).min(whole.width - 0.02 - x);
            let height = (pitch - 0.03) * rng.random_range(0.6..0.97);
            let spine = Area { x, y: bottom, width: thickness, height };
            let value = rng.random_range(40.0..235.0);
            canvas.area(spine, from_hsv(rng.random(), rng.random_range(0.1..0.8), value), 1.0);
            canvas.area(Area { width: 0.002, ..spine }, [20.0; 3], 0.8);
            let ink = if value > 130.0 { [25.0; 3] } else { [235.0; 3] };
            let title = Area {
                x: x + 0.2 * thickness,
                y: bottom + rng.random_range(0.1..0.3) * height,
                width: 0.6 * thickness,
                height: 0.5 * height,
            };
            canvas.print(rng, title, (0.5 * thickness).clamp(0.006, 0.02), ink);
            x += thickness + if rng.random::<f32>() < 0.08 { 0.08 } else { 0.001 };
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn every_material_has_contrast() {
        for material in [
            Material::Wall,
            Material::Ceiling,
            Material::Floor,
            Material::Carton,
            Material::Wood,
            Material::Books,
            Material::Print,
        ] {
            let mut rng = ChaCha8Rng::seed_from_u64(9);
            let texture = paint(material, [0.9, 0.7], 0.005, 1.0, &[], &mut rng);
            let level = &texture.levels[0];
            let n = level.texels.len() as f32;
            let values = || level.texels.iter().map(|t| f32::from(t[1]));
            let mean = values().sum::<f32>() / n;
            let sd = (values().map(|v| (v - mean).powi(2)).sum::<f32>() / n).sqrt();
            assert!(sd > 8.0, "{material:?}: {sd}");
        }
    }

    #[test]
    fn pictures_hang_upright_and_in_proportion() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("quarters.png");
        // Red, green above blue, white; twice as wide as high.
        let quarter = |x: u32, y: u32| match (x < 40, y < 20) {
            (true, true) => image::Rgb([200, 10, 10]),
            (false, true) => image::Rgb([10, 200, 10]),
            (true, false) => image::Rgb([10, 10, 200]),
            (false, false) => image::Rgb([200, 200, 200]),
        };
        image::RgbImage::from_fn(80, 40, quarter).save(&path).unwrap();
        let picture = Picture::load(&path).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let texture = paint(Material::Print, [0.5, 0.5], 0.01, 1.0, &[picture], &mut rng);
        let at = |u, v| texture.sample(u, v, [1e-4, 0.0], [0.0, 1e-4]);
        for (u, v, color) in [
            (0.12, 0.38, [200.0, 10.0, 10.0]),
            (0.38, 0.38, [10.0, 200.0, 10.0]),
            (0.12, 0.12, [10.0, 10.0, 200.0]),
            (0.38, 0.12, [200.0, 200.0, 200.0]),
        ] {
            let seen = at(u, v);
            let near = seen.iter().zip(color).all(|(a, b): (&f32, f32)| (a - b).abs() < 3.0);
            assert!(near, "({u}, {v}): {seen:?} instead of {color:?}");
        }
        assert!(Picture::load(&folder.path().join("absent.png")).is_err());
    }
}
