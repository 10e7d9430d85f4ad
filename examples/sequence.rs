//! A sequence measured four ways: all frames together, each as it is followed, each on its own, and
//! frame to frame in a chain.
//!
//!     cargo run --release --example sequence -- [pinch|pen|contraction] [FRAMES] [VOXELS ALONG X] [SEED]

use palpate::error::FieldError;
use palpate::evaluate::metrics;
use palpate::field::composition::compose;
use palpate::pipeline::field::run;
use palpate::pipeline::known::Known;
use palpate::pipeline::track::{self, Frame};
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
    let measured = |together: bool| {
        let mut fields = Vec::new();
        let keep = |frame: Frame<'_>| -> Result<(), FieldError> {
            fields.push(frame.result.displacement.clone());
            Ok(())
        };
        let read = |t: usize| Ok(sequence.frame(t));
        let volumes = track::Sequence {
            frames: sequence.frames(),
            origin: 0,
            reference: &reference,
            known: Known::mask(mask),
            landmarks: &[],
            labels: None,
            params: &field,
            together,
        };
        let found = track::run(&volumes, read, keep, &|_, _| {})?;
        Ok::<_, FieldError>((fields, found.together))
    };
    let ((followed, _), (all, together)) = (measured(false)?, measured(true)?);
    let mut previous = reference.clone();
    let mut chain = DenseField::zeros(*reference.grid());
    let mut sums = [0.0; 5];
    println!("frame  motion  together  followed  alone  chained (mm)");
    for t in 1..sequence.frames() {
        let (frame, truth) = (sequence.frame(t), sequence.truth(t));
        let alone = run(&reference, &frame, mask, &field, &|_, _| {})?;
        let step = run(&previous, &frame, None, &field, &|_, _| {})?;
        chain = compose(&chain, &step.displacement);
        let error = |u: &DenseField| metrics(u, &truth, mask, &[]);
        let own = error(&followed[t - 1])?;
        let errors = [own.identity_mm, error(&all[t - 1])?.mean_mm, own.mean_mm];
        let [motion, together, followed] = errors;
        let (alone, chained) = (error(&alone.displacement)?.mean_mm, error(&chain)?.mean_mm);
        println!("{t:5}  {motion:6.3}  {together:8.4}  {followed:8.4}  {alone:6.4}  {chained:7.4}");
        for (sum, e) in sums.iter_mut().zip([motion, together, followed, alone, chained]) {
            *sum += e / (sequence.frames() - 1) as f64;
        }
        previous = frame;
    }
    let [motion, all, followed, alone, chained] = sums;
    println!(" mean  {motion:6.3}  {all:8.4}  {followed:8.4}  {alone:6.4}  {chained:7.4}");
    if let Some(together) = together {
        println!("together: {}", together.why);
    }
    Ok(())
}
