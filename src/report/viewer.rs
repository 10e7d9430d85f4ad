//! A viewer for the page: linked orthogonal slices through whole volumes, with overlays, drawn on
//! plain canvases.
//!
//! Images are thinned to about a million and a half voxels, smooth quantities to 120,000, packed
//! with zlib, and unpacked by the browser; nothing is fetched. Values are kept in 8 bits of their
//! scale, displacements to 0.01 mm, places in 16 bits of the extent. Thinned voxels are picked, not
//! averaged: what is shown was measured.

use crate::report::colormap::ColorMap;
use crate::report::field::Values;
use crate::report::html::figure;
use crate::report::scale::Scale;
use crate::report::section::{Canonical, Plane};
use crate::types::{DenseField, Grid, Mask, Match, Mesh, WorldPoint};
use base64::{Engine, engine::general_purpose::STANDARD};
use libdeflater::{CompressionLvl, Compressor};
use maud::{Markup, PreEscaped, html};
use rayon::prelude::*;
use serde_json::{Value, json};

/// Voxels of an image at most.
const IMAGE_VOXELS: usize = 1_500_000;
/// Voxels of a smooth quantity at most, of one moment and of several.
const SMOOTH_VOXELS: [usize; 2] = [120_000, 60_000];
/// Bytes of all moments at most, before they are packed.
const MOMENTS_BYTES: usize = 9_000_000;
/// Matches at most, evenly thinned.
const MAX_MATCHES: usize = 60_000;
/// A mesh of more elements is left out, of one moment and of several.
const ELEMENTS: [usize; 2] = [200_000, 50_000];

/// The tallest picture at most, on the page.
const HEIGHT_PX: f64 = 520.0;

/// A quantity with its name and range.
pub struct Layer<'a> {
    /// What it is called.
    pub name: &'a str,
    /// Its value at a voxel offset.
    pub values: Values<'a>,
    /// Range and colours.
    pub scale: Scale,
}

/// What the value at a voxel is: the value itself (0), a lower bound of it (1) or an upper one (2).
pub type Bounds<'a> = &'a (dyn Fn(usize) -> u8 + Sync);

/// What a viewer shows at one moment: all of it, or what changes over a sequence. On the viewer's
/// grid.
pub struct Moment<'a> {
    /// What it is called where it is one of several; None where it is the only one, which has twice
    /// as many voxels of what is smooth.
    pub name: Option<&'a str>,
    /// In gray, after those that all moments share.
    pub images: &'a [Layer<'a>],
    /// In colour over an image.
    pub overlays: &'a [Layer<'a>],
    /// Where values of the first overlay are bounds: hatched, and read so.
    pub bounds: Option<Bounds<'a>>,
    /// Arrows, grid and magnitude, with the scale of its length.
    pub displacement: Option<(&'a DenseField, Scale)>,
    /// Dots with the scale of their precision.
    pub matches: Option<(&'a [Match], Scale)>,
    /// Lines where elements meet the plane: nodes (mm, RAS) and the corners of each, three or four.
    pub mesh: Option<(&'a [WorldPoint], Vec<u32>, usize)>,
}

/// A moment as the page holds it.
pub struct PackedMoment {
    data: Value,
    maps: Vec<ColorMap>,
}

/// Linked slices with controls. The moments are of one kind: as many images and overlays each, in
/// the same order.
pub struct Viewer<'a> {
    /// The grid.
    pub grid: &'a Grid,
    /// Where the planes cross first (mm, RAS).
    pub centre: WorldPoint,
    /// Colours, arrows and lines are drawn inside it.
    pub mask: Option<&'a Mask>,
    /// In gray, the same at all moments; the first image of all is shown first.
    pub images: &'a [Layer<'a>],
    /// The overlay that is shown first.
    pub shown: Option<usize>,
    /// In the order of time.
    pub moments: &'a [&'a PackedMoment],
    /// The moment that is shown first.
    pub first: usize,
}

/// Nodes and corners of a mesh, for [`Moment::mesh`].
pub fn elements(mesh: &Mesh) -> (&[WorldPoint], Vec<u32>, usize) {
    match mesh {
        Mesh::Tetrahedra(m) => (m.nodes(), m.tetrahedra().as_flattened().to_vec(), 4),
        Mesh::Triangles(m) => (m.nodes(), m.triangles().as_flattened().to_vec(), 3),
    }
}

/// zlib at the quickest level that packs at all (level 0 stores), then base64.
fn pack(bytes: &[u8]) -> String {
    let mut compressor = Compressor::new(CompressionLvl::new(1).unwrap_or_default());
    let mut packed = vec![0; compressor.zlib_compress_bound(bytes.len())];
    // It fits: there is room for the worst case.
    let length = compressor.zlib_compress(bytes, &mut packed).unwrap_or_default();
    STANDARD.encode(&packed[..length])
}

/// Step in voxels along each canonical axis.
struct Thinned<'a> {
    canonical: &'a Canonical,
    steps: [usize; 3],
    shape: [usize; 3],
}

impl<'a> Thinned<'a> {
    /// So that at most `most` voxels are left, as close to cubes as can be.
    fn new(canonical: &'a Canonical, most: usize) -> Self {
        let (len, size) = (canonical.shape(), canonical.spacing());
        let mut edge = size.iter().fold(f64::INFINITY, |m, &v| m.min(v));
        loop {
            let steps: [usize; 3] = std::array::from_fn(|a| ((edge / size[a]).round() as usize).clamp(1, len[a]));
            let shape: [usize; 3] = std::array::from_fn(|a| (len[a] / steps[a]).max(1));
            if shape.iter().product::<usize>() <= most {
                return Self { canonical, steps, shape };
            }
            edge *= 1.1;
        }
    }

    /// `of` the voxel offset of each thinned voxel, x fastest.
    fn map<T: Clone + Default + Send>(&self, of: impl Fn(usize) -> T + Sync) -> Vec<T> {
        let [nx, ny, nz] = self.shape;
        let at = |i: usize, axis: usize| i * self.steps[axis] + (self.steps[axis] - 1) / 2;
        let mut all = vec![T::default(); nx * ny * nz];
        all.par_chunks_mut(nx).enumerate().for_each(|(row, out)| {
            let offset = |i: usize| self.canonical.offset([at(i, 0), at(row % ny, 1), at(row / ny, 2)]) as isize;
            let (first, step) = (offset(0), offset(1.min(nx - 1)) - offset(0));
            for (out, i) in out.iter_mut().zip(0..) {
                *out = of((first + i * step) as usize);
            }
        });
        all
    }

    /// Shape, first voxel's centre and step (mm from the first corner).
    fn lattice(&self) -> Value {
        let size = self.canonical.spacing();
        let step: [f64; 3] = std::array::from_fn(|a| self.steps[a] as f64 * size[a]);
        let first: [f64; 3] = std::array::from_fn(|a| (((self.steps[a] - 1) / 2) as f64 + 0.5) * size[a]);
        json!({ "shape": self.shape, "first": first, "step": step })
    }
}

/// `value` in 8 bits of the scale; what is no number is at its low end.
#[inline(always)]
fn byte(scale: &Scale, value: f32) -> u8 {
    // Saturates, and rounds what is not below 0 to the nearest.
    (255.0 * scale.position(f64::from(value)) + 0.5) as u8
}

/// The byte of an overlay for the end of its scale; the next one is for what lies past it, the last
/// for what is not known.
const END_OF_SCALE: u8 = 253;

/// `value`, which an overlay shows, in 8 bits; what is not finite is not known.
#[inline(always)]
fn code(scale: &Scale, value: f32) -> u8 {
    match scale.position(f64::from(value)) {
        t if !t.is_finite() => END_OF_SCALE + 2,
        // Single precision may lie a little beyond the end that it is meant to be.
        t if t > 1.0 + 1e-6 => END_OF_SCALE + 1,
        t => (f64::from(END_OF_SCALE) * t.min(1.0) + 0.5) as u8,
    }
}

fn with(mut lattice: Value, more: Value) -> Value {
    if let (Value::Object(all), Value::Object(more)) = (&mut lattice, more) {
        all.extend(more);
    }
    lattice
}

fn layers(thinned: &Thinned<'_>, all: &[Layer<'_>], byte: impl Fn(&Scale, f32) -> u8 + Sync) -> Vec<Value> {
    let one = |Layer { name, values, scale }: &Layer<'_>| {
        let bytes = thinned.map(|o| byte(scale, values(o)));
        let about = json!({ "name": name, "low": scale.low, "high": scale.high, "unit": scale.unit,
            "map": map_name(scale.map), "data": pack(&bytes) });
        with(thinned.lattice(), about)
    };
    all.iter().map(one).collect()
}

fn map_name(map: ColorMap) -> String {
    format!("{map:?}").to_lowercase()
}

fn table(map: ColorMap) -> String {
    let rgb: Vec<u8> = (0..=255).flat_map(|i| map.rgb(f64::from(i) / 255.0)).collect();
    STANDARD.encode(rgb)
}

/// Places (mm, RAS) in 16 bits of the extent.
fn places(canonical: &Canonical, points: impl Iterator<Item = WorldPoint>) -> String {
    let extent = canonical.extent_mm();
    let short = |p: WorldPoint| {
        let place = canonical.place(p);
        std::array::from_fn::<_, 3, _>(|a| (65535.0 * (place[a] / extent[a]).clamp(0.0, 1.0)).round() as u16)
    };
    pack(&points.flat_map(short).flat_map(u16::to_le_bytes).collect::<Vec<u8>>())
}

impl Moment<'_> {
    /// Thinned and packed.
    pub fn pack(&self, grid: &Grid) -> PackedMoment {
        let canonical = Canonical::of(grid);
        let fine = Thinned::new(&canonical, IMAGE_VOXELS);
        let several = usize::from(self.name.is_some());
        let coarse = Thinned::new(&canonical, SMOOTH_VOXELS[several]);
        let images = layers(&fine, self.images, byte);
        let mut overlays: Vec<Value> = Vec::new();
        let mut maps: Vec<ColorMap> = Vec::new();
        if let Some((_, scale)) = &self.displacement {
            maps.push(scale.map);
            overlays.push(json!({ "name": "Displacement magnitude", "vector": true, "low": scale.low,
                "high": scale.high, "unit": scale.unit, "map": map_name(scale.map) }));
        }
        maps.extend(self.overlays.iter().map(|l| l.scale.map));
        let mut measured = layers(&coarse, self.overlays, code);
        if let Some((bounds, first)) = self.bounds.zip(measured.first_mut()) {
            first["bounds"] = json!(pack(&coarse.map(bounds)));
        }
        overlays.extend(measured);
        let field = self.displacement.as_ref().map(|(field, _)| {
            let moved = coarse.map(|o| canonical.direct(field.at(o).map(f64::from)));
            let hundredths =
                |v: f64| if v.is_finite() { (100.0 * v).round().clamp(-32767.0, 32767.0) as i16 } else { 0 };
            let bytes: Vec<u8> =
                (0..3).flat_map(|c| moved.iter().flat_map(move |d| hundredths(d[c]).to_le_bytes())).collect();
            with(coarse.lattice(), json!({ "data": pack(&bytes) }))
        });
        let matches = self.matches.as_ref().map(|(all, scale)| {
            maps.push(scale.map);
            let some: Vec<&Match> = all.iter().step_by(all.len().div_ceil(MAX_MATCHES).max(1)).collect();
            let sigma: Vec<u8> = some.iter().map(|m| byte(scale, m.sigma() as f32)).collect();
            let kept: Vec<u8> = some.iter().map(|m| u8::from(m.kept)).collect();
            let place = places(&canonical, some.iter().map(|m| m.initial));
            json!({ "place": place, "sigma": pack(&sigma), "kept": pack(&kept),
                "low": scale.low, "high": scale.high, "map": map_name(scale.map) })
        });
        let mesh =
            self.mesh.as_ref().filter(|m| m.1.len() / m.2 <= ELEMENTS[several]).map(|(nodes, cells, corners)| {
                let cells: Vec<u8> = cells.iter().flat_map(|c| c.to_le_bytes()).collect();
                json!({ "nodes": places(&canonical, nodes.iter().copied()), "cells": pack(&cells), "corners": corners })
            });
        let data = json!({ "name": self.name, "images": images, "overlays": overlays, "field": field,
            "matches": matches, "mesh": mesh });
        PackedMoment { data, maps }
    }

    /// How many moments of this number of images and overlays (with a field) a page has room for;
    /// at least one.
    pub(crate) fn room(grid: &Grid, images: usize, overlays: usize) -> usize {
        let canonical = Canonical::of(grid);
        let voxels = |most| Thinned::new(&canonical, most).shape.iter().product::<usize>();
        let bytes = images * voxels(IMAGE_VOXELS) + (overlays + 6) * voxels(SMOOTH_VOXELS[1]);
        (MOMENTS_BYTES / bytes.max(1)).max(1)
    }
}

impl Viewer<'_> {
    /// Markup, data and script.
    pub fn html(&self) -> Markup {
        let canonical = Canonical::of(self.grid);
        let (fine, coarse) = (Thinned::new(&canonical, IMAGE_VOXELS), Thinned::new(&canonical, SMOOTH_VOXELS[0]));
        let mask = self.mask.map(|mask| {
            let inside = coarse.map(|o| u8::from(mask.as_slice()[o] > 0));
            with(coarse.lattice(), json!({ "data": pack(&inside) }))
        });
        let maps = self.moments.iter().flat_map(|m| &m.maps);
        let planes = canonical.planes();
        let colours: serde_json::Map<String, Value> = maps.map(|m| (map_name(*m), json!(table(*m)))).collect();
        let data = json!({
            "planes": planes.iter().map(|p| p.name()).collect::<Vec<_>>(),
            "extent": canonical.extent_mm(),
            "centre": canonical.place(self.centre),
            "affine": canonical.to_world(),
            "images": layers(&fine, self.images, byte),
            "mask": mask.unwrap_or_else(|| json!({})),
            "moments": self.moments.iter().map(|m| &m.data).collect::<Vec<_>>(),
            "first": self.first,
            "colours": colours,
        });
        // As large as fits on a laptop's screen in one piece.
        let sizes: Vec<[f64; 2]> = planes.iter().map(|p| canonical.size_mm(*p)).collect();
        let tallest = sizes.iter().map(|s| s[1]).fold(1e-9, f64::max);
        let most = (HEIGHT_PX * sizes.iter().map(|s| s[0]).sum::<f64>() / tallest).max(300.0);
        let mut text = data.to_string();
        // Only names could have one; the rest of these megabytes is base64.
        if text.as_bytes().contains(&b'<') {
            text = text.replace("</", "<\\/");
        }
        html! {
            div.viewer {
                (self.choices())
                div.planes style=(format_args!("max-width:{most:.0}px")) {
                    @for (p, size) in planes.iter().zip(&sizes) { (view(*p, *size)) }
                }
                p { output {} }
                div.bar hidden { i {} span {} span {} span {} }
                p.state { "The viewer needs JavaScript." }
                script type="application/json" { (PreEscaped(text)) }
            }
            script { (PreEscaped(include_str!("viewer.js"))) }
        }
    }

    /// What can be chosen.
    fn choices(&self) -> Markup {
        let none = Value::Null;
        let now = self.moments.get(self.first).map_or(&none, |m| &m.data);
        let named = |list: &'static str| now[list].as_array().into_iter().flatten().filter_map(|l| l["name"].as_str());
        let [moves, matches, mesh] = ["field", "matches", "mesh"].map(|part| !now[part].is_null());
        let names: Vec<&str> = named("overlays").collect();
        let images: Vec<&str> = self.images.iter().map(|l| l.name).chain(named("images")).collect();
        let shown = self.shown.map_or(if moves { 0 } else { usize::MAX }, |n| n + usize::from(moves));
        html! {
            div.choices {
                @if self.moments.len() > 1 {
                    label {
                        "moment "
                        input type="range" name="moment" min="0" max=(self.moments.len() - 1) value=(self.first);
                        b {}
                    }
                }
                select name="image" aria-label="Image" { (options(&images, 0)) }
                select name="compare" aria-label="Compare" hidden[images.len() < 2] {
                    option value="alone" { "alone" }
                    option value="flicker" { "flicker with" }
                    option value="checkerboard" { "checkerboard with" }
                }
                select name="other" aria-label="Other image" hidden { (options(&images, images.len() - 1)) }
                select name="colour" aria-label="Colour" {
                    option value="-1" { "no colour" }
                    (options(&names, shown))
                }
                label { "opacity " input type="range" name="opacity" min="0" max="100" value="60"; }
                @if moves { (check("arrows", "arrows", true)) (check("grid", "grid", false)) }
                label hidden[!moves] {
                    "drawn longer "
                    input type="range" name="factor" min="0" max="9" value="0";
                    b {}
                }
                @if matches { (check("matches", "matches", false)) }
                @if mesh { (check("tetrahedra", "mesh", false)) }
                (check("cross", "cross", true))
            }
        }
    }
}

/// A picture of a plane (mm) with its slider.
fn view(plane: Plane, [w, h]: [f64; 2]) -> Markup {
    let canvas = html! { canvas style=(format_args!("aspect-ratio:{w:.2}/{h:.2}")) aria-label=(plane.name()) {} };
    html! {
        div style=(format_args!("flex:{w:.2}")) {
            (figure(plane, [w, h], canvas))
            input type="range" aria-label={ "slice of the " (plane.name()) " plane" };
        }
    }
}

/// Names to choose from.
fn options(names: &[&str], chosen: usize) -> Markup {
    html! { @for (i, name) in names.iter().enumerate() { option value=(i) selected[i == chosen] { (name) } } }
}

/// A box with its words.
fn check(name: &str, words: &str, on: bool) -> Markup {
    html! { label { input type="checkbox" name=(name) checked[on]; " " (words) } }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::Affine;
    use std::io::Read;

    fn unpack(text: &Value) -> Vec<u8> {
        let bytes = STANDARD.decode(text.as_str().unwrap()).unwrap();
        let mut out = Vec::new();
        flate2::read::ZlibDecoder::new(&bytes[..]).read_to_end(&mut out).unwrap();
        out
    }

    fn data(html: &str) -> Value {
        let from = html.find("application/json\">").unwrap() + 18;
        serde_json::from_str(&html[from..from + html[from..].find("</script>").unwrap()]).unwrap()
    }

    #[test]
    fn voxels_places_and_directions_come_out_in_canonical_axes() {
        // World x runs along -k, world y along -i, world z along +j.
        let rows = [[0.0, 0.0, -3.0, 9.0], [-2.0, 0.0, 0.0, 6.0], [0.0, 1.0, 0.0, 0.0]];
        let grid = Grid::new([4, 5, 4], Affine::new(rows).unwrap()).unwrap();
        let x = |o: usize| {
            let [i, j, k] = grid.voxel(o);
            grid.world(i, j, k).0[0] as f32
        };
        let scale = Scale { low: 0.0, high: 255.0, unit: "", map: ColorMap::Gray };
        let field = DenseField::from_fn(grid, |_| [1.0, -2.0, 0.5]);
        let length = Scale::from_zero(3.0, "mm", ColorMap::Viridis);
        let at = Match {
            initial: WorldPoint([9.0, 0.0, 4.0]),
            displacement: [0.0; 3],
            ncc: 1.0,
            covariance: [0.01, 0.01, 0.01, 0.0, 0.0, 0.0],
            kept: true,
            raw: None,
        };
        let moment = Moment {
            name: None,
            images: &[],
            overlays: &[],
            bounds: None,
            displacement: Some((&field, length.clone())),
            matches: Some((&[at], length)),
            mesh: None,
        };
        let viewer = Viewer {
            grid: &grid,
            centre: WorldPoint([3.0, 2.0, 1.0]),
            mask: None,
            images: &[Layer { name: "a", values: &x, scale }],
            shown: None,
            moments: &[&moment.pack(&grid)],
            first: 0,
        };
        let data = data(&viewer.html().into_string());
        let moment = &data["moments"][0];
        assert_eq!(data["images"][0]["shape"], json!([4, 4, 5]));
        assert_eq!(unpack(&data["images"][0]["data"])[..8], [0, 3, 6, 9, 0, 3, 6, 9]);
        let moved: Vec<i16> =
            unpack(&moment["field"]["data"]).chunks(2).map(|b| i16::from_le_bytes([b[0], b[1]])).collect();
        assert_eq!([moved[0], moved[80], moved[160]], [100, -200, 50]);
        // The match lies in the voxel to the right, at the back, on top.
        let place: Vec<f64> = unpack(&moment["matches"]["place"])
            .chunks(2)
            .zip([12.0, 8.0, 5.0])
            .map(|(b, e)| f64::from(u16::from_le_bytes([b[0], b[1]])) / 65535.0 * e)
            .collect();
        for (found, expected) in place.iter().zip([10.5, 1.0, 4.5]) {
            assert!((found - expected).abs() < 1e-3, "{place:?}");
        }
        // The first corner's world place, and back.
        let affine: Vec<Vec<f64>> = serde_json::from_value(data["affine"].clone()).unwrap();
        let world = |p: [f64; 3]| -> Vec<f64> {
            affine.iter().map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3]).collect()
        };
        assert_eq!(world([10.5, 1.0, 4.5]), [9.0, 0.0, 4.0]);
    }

    #[test]
    fn what_repeats_is_packed() {
        assert!(pack(&[1; 100_000]).len() < 1000);
    }

    #[test]
    fn a_page_has_room_for_every_frame_of_a_small_sequence_and_for_one_of_a_large() {
        let room = |shape| Moment::room(&Grid::new(shape, Affine::scaled([1.0; 3], [0.0; 3]).unwrap()).unwrap(), 2, 3);
        assert!(room([48; 3]) > 10);
        assert_eq!(room([140, 68, 44]), 6);
        assert!((1..=3).contains(&room([600, 600, 500])));
    }

    #[test]
    fn past_the_end_of_the_scale_and_not_known_are_told_apart_from_its_end() {
        let scale = Scale { low: 10.0, high: 20.0, unit: "kPa", map: ColorMap::Magma };
        let bytes = [9.0, 10.0, 15.0, 20.0, 20.1, f32::INFINITY, f32::NAN].map(|v| code(&scale, v));
        assert_eq!(bytes, [0, 0, 127, 253, 254, 255, 255]);
        assert_eq!(code(&Scale::from_zero(0.3, "", ColorMap::Magma), 0.3), 253);
    }

    #[test]
    fn large_volumes_are_thinned_to_the_limit_and_small_ones_are_not() {
        let canonical = |shape: [usize; 3], size: [f64; 3]| {
            Canonical::of(&Grid::new(shape, Affine::scaled(size, [0.0; 3]).unwrap()).unwrap())
        };
        let small = canonical([64, 75, 64], [1.0; 3]);
        assert_eq!(Thinned::new(&small, IMAGE_VOXELS).steps, [1; 3]);
        let large = canonical([600, 512, 40], [0.4, 0.4, 4.0]);
        let thinned = Thinned::new(&large, IMAGE_VOXELS);
        assert_eq!(thinned.steps[2], 1, "thick slices stay");
        let n = thinned.shape.iter().product::<usize>();
        assert!(n <= IMAGE_VOXELS && n > IMAGE_VOXELS / 3, "{n}");
        assert!(thinned.map(|o| o).iter().all(|&o| o < 600 * 512 * 40));
        let flat = canonical([900, 900, 1], [0.3, 0.3, 5.0]);
        assert_eq!(Thinned::new(&flat, SMOOTH_VOXELS[0]).shape[2], 1);
    }
}
