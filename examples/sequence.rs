//! A sequence measured three ways: followed, each frame on its own, and frame to frame in a chain.
//!
//!     cargo run --release --example sequence -- [pinch|pen|contraction] [FRAMES] [VOXELS ALONG X] [SEED]

use palpate::evaluate::metrics;
use palpate::field::composition::compose;
use palpate::pipeline::field::run;
use palpate::pipeline::track::Tracker;
use palpate::synth::{Sequence, SequenceKind, SequenceParams};
use palpate::types::{DenseField, FieldParams};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut given = std::env::args().skip(1);
    let kind: SequenceKind = given.next().as_deref().unwrap_or("pinch").parse()?;
    let mut params = SequenceParams::new(kind);
    params.frames = given.next().map_or(Ok(6), |n| n.parse())?;
    if let Some(n) = given.next() {
        params = params.sized(n.parse()?);
    }
    params.seed = given.next().map_or(Ok(1), |n| n.parse())?;
    let sequence = Sequence::new(&params)?;
    let mask = Some(&sequence.mask);

    let field = FieldParams::default();
    let reference = sequence.frame(0);
    let mut tracker = Tracker::new(&reference, mask, &field);
    let mut previous = reference.clone();
    let mut chain = DenseField::zeros(*reference.grid());
    println!("frame  motion  followed  alone  chained (mm)");
    for t in 1..sequence.frames() {
        let (frame, truth) = (sequence.frame(t), sequence.truth(t));
        let followed = tracker.next(&frame, &|_, _| {})?;
        let alone = run(&reference, &frame, mask, &field, &|_, _| {})?;
        let step = run(&previous, &frame, None, &field, &|_, _| {})?;
        chain = compose(&chain, &step.displacement);
        let error = |u: &DenseField| metrics(u, &truth, mask, &[]);
        let (f, a, c) = (error(&followed.displacement)?, error(&alone.displacement)?, error(&chain)?);
        println!("{t:5}  {:6.3}  {:8.3}  {:5.3}  {:7.3}", f.identity_mm, f.mean_mm, a.mean_mm, c.mean_mm);
        previous = frame;
    }
    Ok(())
}
