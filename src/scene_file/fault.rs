//! What is wrong in a TOML file, in one line: file, line, table, key, and what was probably meant.

use super::keys::{Key, around};
use crate::error::{Error, Result};
use serde::de::DeserializeOwned;
use std::path::Path;

/// What `text`, the content of `path`, says.
///
/// # Errors
/// `Invalid` with file, line, key, what was found and what it takes.
pub(crate) fn parse<T: DeserializeOwned>(path: &Path, text: &str) -> Result<T> {
    let takes = |text: &str| toml::from_str::<T>(text).err().map(|e| e.message().to_owned());
    toml::from_str(text).map_err(|e| fault(path, text, &e, takes))
}

/// The error of `text`; `takes` is what is wrong in another one.
fn fault(path: &Path, text: &str, error: &toml::de::Error, takes: impl Fn(&str) -> Option<String>) -> Error {
    let at = error.span().map_or(0, |s| s.start.min(text.len()));
    let line = text[..at].matches('\n').count() + 1;
    let message = error.message().replace('\n', " ");
    // serde: "unknown field `a`, expected one of `b`, `c`"; the same of variants.
    let unknown = message.starts_with("unknown field") || message.starts_with("unknown variant");
    let mut names = message.split('`').skip(1).step_by(2);
    let explained = match (names.next().filter(|_| unknown), around(text, at)) {
        (Some(found), _) => {
            let known: Vec<&str> = names.collect();
            let what = if message.starts_with("unknown field") { "key" } else { "value" };
            let meant = nearest(found, &known).map_or(String::new(), |k| format!("did you mean `{k}`? "));
            let table = table_of(&text[..at]);
            format!("unknown {what} `{found}`{table}; {meant}known: {}", known.join(", "))
        }
        (None, _) if message == "duplicate key" => twice(text[..at].rfind('\n').map_or(text, |end| &text[end + 1..])),
        (None, Some(key)) => wrong_value(text, &message, &key, takes),
        (None, None) => message,
    };
    Error::Invalid(format!("{}:{line}: {explained}", path.display()))
}

/// What is wrong with a key or a table that begins a line of `rest` and was there before.
fn twice(rest: &str) -> String {
    let line = rest.lines().next().unwrap_or_default().trim();
    let header = line.starts_with('[').then(|| line.trim_start_matches('['));
    match header.and_then(|header| header.split_once(']')) {
        Some(("volume", _)) => "[volume] is there already; of several volumes each is a [[volume]]".into(),
        Some((name, _)) => format!("[{name}] is there already"),
        None => format!("{} is there already", line.split('=').next().unwrap_or_default().trim()),
    }
}

/// What is wrong with the value of `key`, of which serde says `message`.
fn wrong_value(text: &str, message: &str, key: &Key, takes: impl Fn(&str) -> Option<String>) -> String {
    let name = key.name();
    let by_type = message.starts_with("invalid type") || message.starts_with("invalid value");
    let expected = match message.rsplit_once(", expected ") {
        Some((_, expected)) if by_type => expected,
        _ if message.starts_with("wanted ") => "a string",
        _ => return format!("{name}: {message}"),
    };
    let found = match key.kind {
        "table" => "a table",
        "array" => "a list",
        _ => text[key.value.clone()].trim(),
    };
    let wanted = match expected {
        // What a text would have to be, it says of one that is nothing.
        "a string" => takes(&[&text[..key.value.start], "\"?\"", &text[key.value.end..]].concat())
            .filter(|message| message.contains('?'))
            .and_then(|message| names(&message))
            .unwrap_or_else(|| "text in quotes".into()),
        "path string" => "a path in quotes".into(),
        "a boolean" => "true or false".into(),
        "f64" => "a number".into(),
        "u16" => "a whole number, 0 to 65535".into(),
        "u32" => "a whole number, 0 to 4294967295".into(),
        "u64" | "usize" => "a whole number, 0 or more".into(),
        "a sequence" if key.kind == "table" => format!("a list of tables: write [[{name}]]"),
        "a sequence" => "a list".into(),
        _ if expected.starts_with("struct") => format!("a table: write [{name}]"),
        other => other.into(),
    };
    format!("{name}: needs {wanted}; found {found}")
}

/// The names or the form that a message about a text asks for.
fn names(message: &str) -> Option<String> {
    if let Some((_, form)) = message.split_once("; write ") {
        return Some(format!("{form}, in quotes"));
    }
    let names: Vec<String> = message.split('`').skip(3).step_by(2).map(|name| format!("\"{name}\"")).collect();
    (!names.is_empty()).then(|| names.join(", "))
}

/// The one of `known` that `found` is a misspelling of, if any is near.
pub(super) fn nearest<'a>(found: &str, known: &[&'a str]) -> Option<&'a str> {
    let likeness = |k: &&str| strsim::jaro_winkler(&found.to_lowercase(), k);
    let best = known.iter().copied().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(&best) > 0.75).then_some(best)
}

/// ` in [table]`, by the last header above; of what stands in a header itself, that of which it is a part.
fn table_of(before: &str) -> String {
    let last = before.lines().last().unwrap_or_default().trim();
    if last.starts_with('[') && !last.contains(']') {
        let parent = last.trim_start_matches('[').rsplit_once('.').map(|(parent, _)| parent);
        return parent.map_or_else(String::new, |p| format!(" in [{p}]"));
    }
    let header = before.lines().rev().map(str::trim).find(|l| l.starts_with('['));
    let closing = |l: &str| if l.starts_with("[[") { "]]" } else { "]" };
    header.and_then(|l| Some(format!(" in {}{}", l.split(']').next()?, closing(l)))).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn misspellings_find_what_was_meant() {
        let known = ["albedo", "emission", "outside", "sides", "boundary"];
        for (found, meant) in
            [("albdo", Some("albedo")), ("Emission", Some("emission")), ("side", Some("sides")), ("xyzzy", None)]
        {
            assert_eq!(nearest(found, &known), meant, "{found}");
        }
    }
}
