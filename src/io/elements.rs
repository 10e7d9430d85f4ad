//! The elements of a DICOM file (PS3.5 section 7, PS3.10), little-endian: where each value of the
//! outermost level stands.
//!
//! Values are never copied, sequences are stepped over, and every length is checked against the
//! file's.

use std::collections::BTreeMap;
use std::ops::Range;

/// Group and element.
pub(super) type Tag = (u16, u16);

const SYNTAX: Tag = (0x0002, 0x0010);
const ITEM: Tag = (0xfffe, 0xe000);
const ITEM_END: Tag = (0xfffe, 0xe00d);
const SEQUENCE_END: Tag = (0xfffe, 0xe0dd);
/// A length that only an end mark tells.
const UNDEFINED: usize = 0xffff_ffff;
/// Sequences in sequences at most.
const DEEPEST: usize = 16;

/// Places of the values of a file.
pub(super) struct Elements<'a> {
    bytes: &'a [u8],
    places: BTreeMap<Tag, Range<usize>>,
}

impl<'a> Elements<'a> {
    /// Of a whole file; none where it is damaged or in another transfer syntax than implicit or
    /// explicit little-endian.
    pub(super) fn of(bytes: &'a [u8]) -> Option<Self> {
        if bytes.get(128..132)? != b"DICM" {
            return None;
        }
        let mut out = Self { bytes, places: BTreeMap::new() };
        let (mut at, mut explicit) = (132, true);
        while at < bytes.len() {
            if tag(bytes, at)?.0 != 2 {
                break;
            }
            at = out.add(at, true)?;
        }
        match out.get(SYNTAX).map(|v| v.trim_ascii_end().strip_suffix(b"\0").unwrap_or(v.trim_ascii_end()))? {
            b"1.2.840.10008.1.2" => explicit = false,
            b"1.2.840.10008.1.2.1" => {}
            _ => return None,
        }
        while at < bytes.len() {
            at = out.add(at, explicit)?;
        }
        Some(out)
    }

    /// Notes the element at `at`; where the next one begins.
    fn add(&mut self, at: usize, explicit: bool) -> Option<usize> {
        let element = Element::at(self.bytes, at, explicit)?;
        let end = element.end(self.bytes, 0)?;
        self.places.insert(element.tag, element.value..end);
        Some(end)
    }

    /// The value of an element of the outermost level.
    pub(super) fn get(&self, tag: Tag) -> Option<&'a [u8]> {
        self.bytes.get(self.place(tag)?)
    }

    /// Where it stands in the file.
    pub(super) fn place(&self, tag: Tag) -> Option<Range<usize>> {
        self.places.get(&tag).cloned()
    }
}

fn tag(bytes: &[u8], at: usize) -> Option<Tag> {
    let number = |at: usize| Some(u16::from_le_bytes(*bytes.get(at..)?.first_chunk()?));
    Some((number(at)?, number(at + 2)?))
}

fn length(bytes: &[u8], at: usize) -> Option<usize> {
    Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?) as usize)
}

struct Element {
    tag: Tag,
    value: usize,
    length: usize,
    /// Whether the elements inside a sequence have a VR.
    explicit: bool,
}

impl Element {
    fn at(bytes: &[u8], at: usize, explicit: bool) -> Option<Self> {
        let tag = tag(bytes, at)?;
        if !explicit || tag.0 == ITEM.0 {
            return Some(Self { tag, value: at + 8, length: length(bytes, at + 4)?, explicit });
        }
        let vr = bytes.get(at + 4..at + 6)?;
        const LONG: [&[u8]; 13] =
            [b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"];
        if LONG.contains(&vr) {
            return Some(Self { tag, value: at + 12, length: length(bytes, at + 8)?, explicit: vr != b"UN" });
        }
        let length = usize::from(u16::from_le_bytes(*bytes.get(at + 6..)?.first_chunk()?));
        Some(Self { tag, value: at + 8, length, explicit })
    }

    /// Where what follows begins.
    fn end(&self, bytes: &[u8], depth: usize) -> Option<usize> {
        if self.length != UNDEFINED {
            return self.value.checked_add(self.length).filter(|&end| end <= bytes.len());
        }
        if depth > DEEPEST {
            return None;
        }
        // Items up to the end mark of the sequence, or elements up to that of the item.
        let mut at = self.value;
        loop {
            let inside = Element::at(bytes, at, self.explicit)?;
            match inside.tag {
                SEQUENCE_END if self.tag != ITEM => return Some(at + 8),
                ITEM_END if self.tag == ITEM => return Some(at + 8),
                _ => at = inside.end(bytes, depth + 1)?,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn element(tag: Tag, vr: &[u8; 2], length: u32, value: &[u8]) -> Vec<u8> {
        let mut out = [tag.0.to_le_bytes(), tag.1.to_le_bytes()].concat();
        if tag.0 == ITEM.0 {
            out.extend(length.to_le_bytes());
        } else if vr == b"SQ" {
            out.extend(b"SQ\0\0");
            out.extend(length.to_le_bytes());
        } else {
            out.extend(vr);
            out.extend((length as u16).to_le_bytes());
        }
        out.extend(value);
        out
    }

    #[test]
    fn sequences_of_unknown_length_are_stepped_over() {
        let syntax = b"1.2.840.10008.1.2.1\0";
        let inner = element((0x0028, 0x0010), b"US", 2, &[9, 9]);
        let item = |inside: &[u8], known: bool| match known {
            true => element(ITEM, b"  ", inside.len() as u32, inside),
            false => element(ITEM, b"  ", u32::MAX, &[inside, &element(ITEM_END, b"  ", 0, &[])[..]].concat()),
        };
        let end = element(SEQUENCE_END, b"  ", 0, &[]);
        let nested = element((0x0008, 0x1111), b"SQ", u32::MAX, &[item(&inner, false), end.clone()].concat());
        let sequence =
            element((0x0008, 0x1110), b"SQ", u32::MAX, &[item(&inner, true), item(&nested, false), end].concat());
        let file = [
            vec![0; 128],
            b"DICM".to_vec(),
            element(SYNTAX, b"UI", syntax.len() as u32, syntax),
            sequence,
            element((0x0028, 0x0010), b"US", 2, &[3, 0]),
        ]
        .concat();
        let found = Elements::of(&file).unwrap();
        assert_eq!(found.get((0x0028, 0x0010)), Some(&[3, 0][..]), "not the one inside the sequence");
        for end in 133..file.len() {
            if let Some(part) = Elements::of(&file[..end]) {
                assert!(part.get((0x0028, 0x0010)).is_none());
            }
        }
    }
}
