//! What is wrong in a TOML file, in one line: file, line, table, key, and what was probably meant.

use crate::error::Error;
use std::path::Path;

/// The error of `text`, the content of `path`, as `toml` found it.
pub fn fault(path: &Path, text: &str, error: &toml::de::Error) -> Error {
    let at = error.span().map_or(0, |s| s.start.min(text.len()));
    let line = text[..at].matches('\n').count() + 1;
    let message = error.message().replace('\n', " ");
    // serde: "unknown field `a`, expected one of `b`, `c`"; the same of variants.
    let unknown = message.starts_with("unknown field") || message.starts_with("unknown variant");
    let mut names = message.split('`').skip(1).step_by(2);
    let explained = match names.next().filter(|_| unknown) {
        None => message,
        Some(found) => {
            let known: Vec<&str> = names.collect();
            let what = if message.starts_with("unknown field") { "key" } else { "value" };
            let meant = nearest(found, &known).map_or(String::new(), |k| format!("did you mean `{k}`? "));
            let table = table_of(&text[..at]);
            format!("unknown {what} `{found}`{table}; {meant}known: {}", known.join(", "))
        }
    };
    Error::Invalid(format!("{}:{line}: {explained}", path.display()))
}

/// The one of `known` that `found` is a misspelling of, if any is near.
fn nearest<'a>(found: &str, known: &[&'a str]) -> Option<&'a str> {
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
