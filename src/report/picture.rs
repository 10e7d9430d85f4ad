//! A section as a PNG with 256 colours: gray where only anatomy is shown, colour where there is a
//! value.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::scale::Scale;
use crate::report::section::{Plane, Section};
use base64::{Engine, engine::general_purpose::STANDARD};

/// An encoded section with its proportions.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// The file's bytes.
    pub png: Vec<u8>,
    /// Extent to the right and down (mm).
    pub size_mm: [f64; 2],
    /// Which plane.
    pub plane: Plane,
}

/// Half of the palette is gray, half is the scale's.
const HALF: u8 = 128;

impl Picture {
    /// Gray levels between black at `range[0]` and white at `range[1]`.
    ///
    /// # Errors
    /// [`ReportError`] when the encoder refuses.
    pub fn gray(section: &Section, value: impl Fn(usize) -> f32, range: [f64; 2]) -> Result<Self, ReportError> {
        let scale = Scale { low: range[0], high: range[1], unit: "", map: ColorMap::Gray };
        Self::overlay(section, value, range, |_| None, &scale)
    }

    /// Colours by `scale` where `value` gives a number, over gray levels of `base` elsewhere.
    ///
    /// # Errors
    /// As [`Picture::gray`].
    pub fn overlay(
        section: &Section,
        base: impl Fn(usize) -> f32,
        range: [f64; 2],
        value: impl Fn(usize) -> Option<f32>,
        scale: &Scale,
    ) -> Result<Self, ReportError> {
        let level = |t: f64| (t.clamp(0.0, 1.0) * f64::from(HALF - 1)).round() as u8;
        let gray = section.sample(|o| Some(base(o)));
        let colour = section.sample(value);
        let width = (range[1] - range[0]).max(f64::MIN_POSITIVE);
        let indices: Vec<u8> = gray
            .iter()
            .zip(&colour)
            .map(|(g, c)| match c {
                Some(v) => HALF + level(scale.position(f64::from(*v))),
                None => level((f64::from(g.unwrap_or_default()) - range[0]) / width),
            })
            .collect();
        let table = |map: ColorMap| (0..HALF).flat_map(move |i| map.rgb(f64::from(i) / f64::from(HALF - 1)));
        let palette = table(ColorMap::Gray).chain(table(scale.map)).collect();
        let png = encode(section.width, section.height, palette, &indices)?;
        Ok(Self { png, size_mm: section.size_mm(), plane: section.plane })
    }

    /// The picture as a `data:` address, for a page or drawing that stands alone.
    pub(crate) fn data_uri(&self) -> String {
        format!("data:image/png;base64,{}", STANDARD.encode(&self.png))
    }
}

/// An indexed PNG, rows from the top.
pub(super) fn encode(width: usize, height: usize, palette: Vec<u8>, indices: &[u8]) -> Result<Vec<u8>, ReportError> {
    let failed = |e: png::EncodingError| ReportError::Picture { what: e.to_string() };
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_palette(palette);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(indices).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::{Affine, Grid, WorldPoint};

    #[test]
    fn pixels_come_back_from_the_png() {
        let grid = Grid::new([3, 2, 1], Affine::scaled([1.0, 1.0, 1.0], [0.0; 3]).unwrap()).unwrap();
        let section = &Section::through(&grid, WorldPoint([0.0; 3]))[0];
        let scale = Scale::from_zero(1.0, "mm", ColorMap::Viridis);
        let picture = Picture::overlay(section, |o| o as f32, [0.0, 5.0], |o| (o == 5).then_some(1.0), &scale).unwrap();
        let mut decoder = png::Decoder::new(std::io::Cursor::new(&picture.png));
        decoder.set_transformations(png::Transformations::EXPAND);
        let mut reader = decoder.read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut rgb).unwrap();
        assert_eq!((reader.info().width, reader.info().height), (3, 2));
        // The upper row has the higher y: offsets 3, 4, 5; then 0, 1, 2.
        let red: Vec<u8> = rgb.chunks(3).map(|p| p[0]).collect();
        let gray = |v: f64| (255.0 * (v / 5.0 * 127.0).round() / 127.0).round() as u8;
        assert_eq!(red, [gray(3.0), gray(4.0), ColorMap::Viridis.rgb(1.0)[0], gray(0.0), gray(1.0), gray(2.0)]);
        assert!(picture.data_uri().starts_with("data:image/png;base64,iVBOR"));
    }
}
