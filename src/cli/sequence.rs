//! `palpate phantom pinch|pen|contraction`: a sequence of volumes with exactly known displacement.

use super::console::Console;
use anyhow::Result;
use palpate::io::{self, OutputFolder};
use palpate::report::figure;
use palpate::report::panels::{Panel, centre_of_motion, gray_range};
use palpate::report::section::Section;
use palpate::synth::{Sequence, SequenceParams};
use palpate::types::WorldPoint;
use serde_json::json;

/// Frames in the picture.
const FRAMES_SHOWN: usize = 4;

/// Stages `frame_<t>.nii.gz`, `truth_<t>.nii.gz`, mask, labels, description and picture; gives the
/// summary back.
pub fn write(folder: &mut OutputFolder, params: &SequenceParams, console: &Console) -> Result<String> {
    let progress = console.progress();
    progress.set("phantom", 0.0);
    let sequence = Sequence::new(params)?;
    let frames = sequence.frames();
    folder.write("mask.nii.gz", |p| io::write_labels(p, &sequence.mask, "palpate phantom: tissue of frame 0"))?;
    folder.write("labels.nii.gz", |p| io::write_labels(p, &sequence.labels, "palpate phantom: regions of frame 0"))?;
    let mut panels = Vec::new();
    let mut cut: Option<(Vec<Section>, [f64; 2])> = None;
    let (mut mean, mut largest) = (Vec::with_capacity(frames), Vec::with_capacity(frames));
    for t in 0..frames {
        progress.set("phantom", t as f64 / frames as f64);
        let (frame, truth) = (sequence.frame(t), sequence.truth(t));
        folder.write(&format!("frame_{t:03}.nii.gz"), |p| io::write_integers(p, &frame, "palpate phantom"))?;
        folder.write(&format!("truth_{t:03}.nii.gz"), |p| io::write_field(p, &truth))?;
        let inside = (0..frame.grid().len()).filter(|&at| sequence.mask.as_slice()[at] != 0);
        let lengths: Vec<f64> =
            inside.map(|at| truth.at(at).iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt()).collect();
        mean.push(lengths.iter().sum::<f64>() / lengths.len().max(1) as f64);
        largest.push(lengths.iter().copied().fold(0.0, f64::max));
        let (sections, range) = cut.get_or_insert_with(|| {
            let last = sequence.truth(frames / 2);
            let centre: WorldPoint = centre_of_motion(&last, Some(&sequence.mask));
            (Section::through(frame.grid(), centre), gray_range(&frame))
        });
        if t % frames.div_ceil(FRAMES_SHOWN) == 0 {
            let values = frame.as_slice();
            panels.push(Panel::gray(&format!("frame {t}"), sections, |o| values[o], *range)?);
        }
    }
    let description = json!({
        "params": params, "noise_sigma": sequence.noise_sigma, "mean_mm": mean, "max_mm": largest,
    });
    folder.write("phantom.json", |p| io::write_json(p, &description))?;
    let title = format!("{:?}, {frames} frames, seed {}", params.kind, params.seed);
    folder.write("phantom.svg", |p| io::write_text(p, &figure::figure(&title, &panels)))?;
    let top = largest.iter().copied().fold(0.0, f64::max);
    Ok(format!("{:?}: {frames} frames, tissue moves {top:.2} mm at most.\n", params.kind))
}
