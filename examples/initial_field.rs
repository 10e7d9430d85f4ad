//! Matches of one's own handed in, as the field in which the registration starts.
//!
//!     cargo run --release --example initial_field -- [INITIAL DEFORMED MATCHES]
//!
//! MATCHES is a table of places in both volumes (fx,fy,fz,mx,my,mz; world mm, RAS). Without files the
//! pair is a synthetic block that lies 40 mm aside: the search alone does not reach so far.

use palpate::evaluate::landmarks;
use palpate::pipeline::field::run_from;
use palpate::pipeline::known::{InitialField, Known};
use palpate::types::space::length;
use palpate::{Affine, FieldParams, Grid, Landmark, PhantomKind, PhantomParams, Volume, io, phantom};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let files: Vec<String> = std::env::args().skip(1).collect();
    let (initial, deformed, matches): (Volume, Volume, Vec<Landmark>) = match &files[..] {
        [a, b, matches] => (io::read_volume(a)?, io::read_volume(b)?, io::read_landmarks(matches)?),
        [] => {
            let block = phantom(&PhantomParams::new(PhantomKind::Block).sized(48))?;
            let (grid, aside) = (*block.deformed.grid(), [40.0, 0.0, 0.0]);
            let rows = std::array::from_fn(|r| {
                let [a, b, c, offset] = grid.affine().rows()[r];
                [a, b, c, offset + aside[r]]
            });
            let deformed = block.deformed.placed(Grid::new(grid.shape(), Affine::new(rows)?)?)?;
            let moved = |m: &Landmark| Landmark { deformed: m.deformed.moved(aside), ..*m };
            (block.initial, deformed, block.landmarks.iter().map(moved).collect())
        }
        _ => return Err("give INITIAL, DEFORMED and MATCHES, or nothing".into()),
    };

    let field = InitialField::from_matches(&matches).ok_or("there are no matches")?;
    let start = |place| Some(field.at(place));
    let known = Known { start: Some(&start), ..Known::default() };
    let found = run_from(&initial, &deformed, &known, &FieldParams::default(), &[], &|_, _| {})?;
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / matches.len() as f64;
    let error = mean(landmarks(&found.displacement, &matches));
    let motion = mean(matches.iter().map(|m| length(m.deformed.minus(m.initial))).collect());
    println!("mean error {error:.3} mm of a motion of {motion:.3} mm at {} matches", matches.len());
    Ok(())
}
