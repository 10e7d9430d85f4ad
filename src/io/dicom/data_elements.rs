//! The elements of a DICOM file (PS3.5 section 7, PS3.10): where each value of one level stands.
//!
//! Values are never copied, sequences are stepped over until they are asked for, and every length
//! is checked against the file's: no length in a file makes it allocate. (The crate `dicom-object`
//! allocates what a length says before it reads the value, up to 4 GB for a file of 200 bytes.)

use std::collections::BTreeMap;
use std::ops::Range;

/// Group and element.
pub(super) type Tag = (u16, u16);

const ITEM: Tag = (0xfffe, 0xe000);
const ITEM_END: Tag = (0xfffe, 0xe00d);
const SEQUENCE_END: Tag = (0xfffe, 0xe0dd);
/// A length that only an end mark tells.
const UNDEFINED_LENGTH: usize = 0xffff_ffff;
/// Sequences in sequences at most.
const MAX_NESTING: usize = 16;

/// How elements are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Form {
    /// Whether each has its VR.
    pub(super) explicit: bool,
    pub(super) big_endian: bool,
}

impl Form {
    pub(super) const EXPLICIT: Self = Self { explicit: true, big_endian: false };

    /// A binary 16-bit number.
    pub(super) fn short(self, bytes: &[u8]) -> Option<u16> {
        let b = *bytes.first_chunk()?;
        Some(if self.big_endian { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) })
    }

    pub(super) fn long(self, bytes: &[u8]) -> Option<usize> {
        let b = *bytes.first_chunk()?;
        Some(if self.big_endian { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) } as usize)
    }

    fn tag(self, bytes: &[u8], at: usize) -> Option<Tag> {
        Some((self.short(bytes.get(at..)?)?, self.short(bytes.get(at + 2..)?)?))
    }
}

/// Places of the values of one level.
#[derive(Debug)]
pub(super) struct Elements<'a> {
    bytes: &'a [u8],
    pub(super) form: Form,
    places: BTreeMap<Tag, Element>,
}

impl<'a> Elements<'a> {
    /// Those in a range of `bytes`; none where it is damaged.
    pub(super) fn of(bytes: &'a [u8], range: Range<usize>, form: Form) -> Option<Self> {
        let mut out = Self { bytes: bytes.get(..range.end)?, form, places: BTreeMap::new() };
        let mut at = range.start;
        while at < range.end {
            at = out.add(at)?;
        }
        Some(out)
    }

    /// Those about the file (group 2), and where what they tell of begins; none where it is not
    /// DICOM.
    pub(super) fn about(bytes: &'a [u8]) -> Option<(Self, usize)> {
        if bytes.get(128..132)? != b"DICM" {
            return None;
        }
        let (mut out, mut at) = (Self { bytes, form: Form::EXPLICIT, places: BTreeMap::new() }, 132);
        while out.form.tag(bytes, at).is_some_and(|tag| tag.0 == 2) {
            at = out.add(at)?;
        }
        Some((out, at))
    }

    /// Notes the element at `at`; where the next one begins.
    fn add(&mut self, at: usize) -> Option<usize> {
        let mut element = Element::at(self.bytes, at, self.form)?;
        let next = element.next(self.bytes, 0)?;
        if element.length == UNDEFINED_LENGTH {
            element.length = next - 8 - element.value; // without the end mark
        }
        self.places.insert(element.tag, element);
        Some(next)
    }

    /// The value of an element.
    pub(super) fn get(&self, tag: Tag) -> Option<&'a [u8]> {
        self.bytes.get(self.places.get(&tag)?.range())
    }

    /// The items of a sequence, each as they stand in the file; those that are damaged end it.
    fn inside(&self, tag: Tag) -> impl Iterator<Item = Element> {
        let found = self.places.get(&tag);
        let (form, mut at, end) = found.map_or((self.form, 0, 0), |e| (e.form, e.value, e.range().end));
        std::iter::from_fn(move || {
            let item = Element::at(self.bytes, at, form).filter(|item| at < end && item.tag == ITEM)?;
            let next = item.next(self.bytes, 1)?;
            let length = if item.length == UNDEFINED_LENGTH { next - 8 - item.value } else { item.length };
            at = next;
            Some(Element { length, ..item })
        })
    }

    /// What each item of a sequence holds.
    pub(super) fn items(&self, tag: Tag) -> impl Iterator<Item = Elements<'a>> {
        self.inside(tag).filter_map(|item| Self::of(self.bytes, item.range(), item.form))
    }

    /// The pieces of a packed value.
    pub(super) fn pieces(&self, tag: Tag) -> impl Iterator<Item = &'a [u8]> {
        self.inside(tag).filter_map(|item| self.bytes.get(item.range()))
    }
}

#[derive(Debug, Clone)]
struct Element {
    tag: Tag,
    value: usize,
    length: usize,
    /// How the elements inside a sequence are written.
    form: Form,
}

impl Element {
    fn at(bytes: &[u8], at: usize, form: Form) -> Option<Self> {
        let tag = form.tag(bytes, at)?;
        if !form.explicit || tag.0 == ITEM.0 {
            return Some(Self { tag, value: at + 8, length: form.long(bytes.get(at + 4..)?)?, form });
        }
        let vr = bytes.get(at + 4..at + 6)?;
        const LONG: [&[u8]; 13] =
            [b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"];
        if LONG.contains(&vr) {
            // What is in an unknown value is implicit little-endian (PS3.5, 6.2.2).
            let inside = if vr == b"UN" { Form { explicit: false, big_endian: false } } else { form };
            return Some(Self { tag, value: at + 12, length: form.long(bytes.get(at + 8..)?)?, form: inside });
        }
        let length = usize::from(form.short(bytes.get(at + 6..)?)?);
        Some(Self { tag, value: at + 8, length, form })
    }

    fn range(&self) -> Range<usize> {
        self.value..self.value.saturating_add(self.length)
    }

    /// Where what follows begins.
    fn next(&self, bytes: &[u8], depth: usize) -> Option<usize> {
        if self.length != UNDEFINED_LENGTH {
            return self.value.checked_add(self.length).filter(|&end| end <= bytes.len());
        }
        if depth > MAX_NESTING {
            return None;
        }
        // Items up to the end mark of the sequence, or elements up to that of the item.
        let mut at = self.value;
        loop {
            let inside = Self::at(bytes, at, self.form)?;
            match inside.tag {
                SEQUENCE_END if self.tag != ITEM => return Some(at + 8),
                ITEM_END if self.tag == ITEM => return Some(at + 8),
                _ => at = inside.next(bytes, depth + 1)?,
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
        let inner = element((0x0028, 0x0010), b"US", 2, &[9, 9]);
        let item = |inside: &[u8], known: bool| match known {
            true => element(ITEM, b"  ", inside.len() as u32, inside),
            false => element(ITEM, b"  ", u32::MAX, &[inside, &element(ITEM_END, b"  ", 0, &[])[..]].concat()),
        };
        let end = element(SEQUENCE_END, b"  ", 0, &[]);
        let nested = element((0x0008, 0x1111), b"SQ", u32::MAX, &[item(&inner, false), end.clone()].concat());
        let sequence =
            element((0x0008, 0x1110), b"SQ", u32::MAX, &[item(&inner, true), item(&nested, false), end].concat());
        let file = [sequence, element((0x0028, 0x0010), b"US", 2, &[3, 0])].concat();
        let rows = (0x0028, 0x0010);
        let found = Elements::of(&file, 0..file.len(), Form::EXPLICIT).unwrap();
        assert_eq!(found.get(rows), Some(&[3, 0][..]), "not the one inside the sequence");
        let items: Vec<Elements<'_>> = found.items((0x0008, 0x1110)).collect();
        assert_eq!(items.len(), 2);
        assert_eq!(items[0].get(rows), Some(&[9, 9][..]));
        assert_eq!(items[1].items((0x0008, 0x1111)).next().unwrap().get(rows), Some(&[9, 9][..]));
        for end in 0..file.len() {
            if let Some(part) = Elements::of(&file, 0..end, Form::EXPLICIT) {
                assert!(part.get(rows).is_none());
            }
        }
    }
}
