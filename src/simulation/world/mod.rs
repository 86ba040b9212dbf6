//! Rooms full of boxes, and rays through them.

mod furniture;
mod light;
mod people;
mod solid;

use std::path::PathBuf;

use nalgebra::{Isometry3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::texture::{Grain, Picture};
use furniture::{Plan, furnish, shell};
use light::{finished_face, lamps};
pub use people::PeopleConfig;
use people::{PERSON, Round, person, round};
pub(super) use solid::{Hit, Solid, View};

/// The room and what stands in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RoomConfig {
    /// Inner length (x), width (y) and height (z), m; enlarged where the path needs more. The
    /// origin is in the middle of the floor.
    pub size: [f64; 3],
    /// Number of pieces of furniture and piles of boxes; fewer where they do not fit.
    pub clutter: usize,
    /// Texture of the surfaces, from 0 (bare) to 1 (busy).
    pub richness: f64,
    /// Edge of a texel of the large surfaces, m; small ones have up to twice the resolution.
    /// Memory grows with its inverse square.
    pub texel: f64,
    /// Free space kept around the path, m.
    pub clearance: f64,
    /// Image files (PNG, JPEG) for posters, screens and printed boxes, as seen from the working
    /// directory; none: invented ones.
    pub images: Vec<PathBuf>,
}

impl Default for RoomConfig {
    fn default() -> Self {
        Self {
            size: [7.0, 6.0, 2.8],
            clutter: 26,
            richness: 0.8,
            texel: 0.005,
            clearance: 0.7,
            images: Vec::new(),
        }
    }
}

/// Everything that the camera can see.
#[derive(Debug)]
pub struct World {
    pub(super) solids: Vec<Solid>,
    pub(super) grain: Grain,
    /// Rounds of the people, whose boxes are the last of `solids`, three each.
    rounds: Vec<Round>,
}

impl World {
    /// Builds a furnished room that leaves `path` (positions of the sensor, m) free, with
    /// `pictures` on its posters.
    pub fn furnished(
        room: &RoomConfig,
        people: &PeopleConfig,
        path: &[Vector3<f64>],
        pictures: &[Picture],
        seed: u64,
    ) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut plans = vec![shell(room)];
        for _ in 0..room.clutter {
            furnish(&mut plans, room, path, &mut rng);
        }
        let grain = Grain::new(&mut rng);
        // People cast no shadows: light is baked once, without them.
        let bare: Vec<Solid> = plans.iter().map(Plan::solid).collect();
        let rounds: Vec<Round> =
            (0..people.count).filter_map(|_| round(&plans, room, people, path, &mut rng)).collect();
        for round in &rounds {
            plans.extend(person(round));
        }
        let lamps = lamps(room);
        let solids = plans
            .par_iter()
            .enumerate()
            .map(|(index, plan)| {
                let face = |face: usize| {
                    let mut rng = ChaCha8Rng::seed_from_u64(seed);
                    rng.set_stream((6 * index + face) as u64 + 1);
                    finished_face((plan, face), room, pictures, (&bare, &lamps), &mut rng)
                };
                Solid { faces: (0..6).into_par_iter().map(face).collect(), ..plan.solid() }
            })
            .collect();
        Self { solids, grain, rounds }
    }

    /// Moves what moves to where it is at `t` seconds.
    pub(super) fn advance(&mut self, t: f64) {
        let first = self.solids.len() - PERSON.len() * self.rounds.len();
        for (round, parts) in self.rounds.iter().zip(self.solids[first..].chunks_mut(PERSON.len()))
        {
            for (part, (height, size)) in parts.iter_mut().zip(PERSON) {
                let middle = Isometry3::translation(0.0, 0.0, height + 0.5 * size[2]);
                part.world_from_box = (round.pose(t) * middle).cast();
            }
        }
    }
}
