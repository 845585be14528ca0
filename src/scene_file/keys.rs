//! Where the keys of a TOML file stand.

use std::ops::Range;
use toml::de::{DeTable, DeValue};

/// A key and its value.
pub(super) struct Key {
    /// The keys that lead to it, of lists the indices.
    pub(super) path: Vec<String>,
    /// The bytes of its value; of a table, of its header.
    pub(super) value: Range<usize>,
    /// What the value is: `table`, `array`, `string` …
    pub(super) kind: &'static str,
}

impl Key {
    /// Its own name; of an element of a list, the list's.
    pub(super) fn name(&self) -> &str {
        let named = self.path.iter().rev().find(|step| step.parse::<usize>().is_err());
        named.map_or("", String::as_str)
    }
}

/// Where the key at `path` begins, or the last on the way that is there. Indices of lists are steps, too.
pub(super) fn find(text: &str, path: &[&str]) -> Option<usize> {
    let root = DeTable::parse(text).ok()?;
    let (mut value, mut at) = (&DeValue::Table(root.into_inner()), None);
    for step in path {
        let Some((_, key, _, inner)) = children(value).into_iter().find(|child| child.0 == *step) else { break };
        (value, at) = (inner, Some(key.start));
    }
    at
}

/// The innermost key that byte `at` belongs to, or to its value.
pub(super) fn around(text: &str, at: usize) -> Option<Key> {
    fn inner(value: &DeValue, path: &[String], at: usize) -> Option<Key> {
        children(value).into_iter().find_map(|(step, key, span, child)| {
            let path = [path, &[step]].concat();
            let kind = || Key { path: path.clone(), value: span.clone(), kind: child.type_str() };
            inner(child, &path, at).or_else(|| (key.contains(&at) || span.contains(&at)).then(kind))
        })
    }
    inner(&DeValue::Table(DeTable::parse(text).ok()?.into_inner()), &[], at)
}

/// What a table or a list holds: step, bytes of the key (of an element, of itself) and of the value, and this.
fn children<'a, 'i>(value: &'a DeValue<'i>) -> Vec<(String, Range<usize>, Range<usize>, &'a DeValue<'i>)> {
    match value {
        DeValue::Table(table) => {
            table.iter().map(|(k, v)| (k.get_ref().to_string(), k.span(), v.span(), v.get_ref())).collect()
        }
        DeValue::Array(list) => {
            list.iter().enumerate().map(|(n, v)| (n.to_string(), v.span(), v.span(), v.get_ref())).collect()
        }
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_found_in_their_own_tables() {
        let text = "[[context]]\nfile = \"a\"\n[[context]]\nscale = 2\nfile = \"b\"\n[volume]\nfile = \"c\"\nraw.type = \"u8\"\n";
        let line = |path: &[&str]| find(text, path).map(|at| text[..at].matches('\n').count() + 1);
        for (path, expected) in [
            (&["context", "0", "file"][..], Some(2)),
            (&["context", "1", "file"], Some(5)),
            (&["context", "1", "albedo"], Some(3)),
            (&["volume", "file"], Some(7)),
            (&["volume", "raw", "type"], Some(8)),
            (&["volume", "times"], Some(6)),
            (&["box", "kind"], None),
        ] {
            assert_eq!(line(path), expected, "{path:?}");
        }
        let at = |what: &str| around(text, text.find(what).unwrap()).unwrap();
        assert_eq!(
            (at("\"b\"").path, at("\"b\"").kind),
            (["context", "1", "file"].map(String::from).to_vec(), "string")
        );
        assert_eq!((at("2").name().to_owned(), at("\"u8\"").name().to_owned()), ("scale".into(), "type".into()));
    }
}
