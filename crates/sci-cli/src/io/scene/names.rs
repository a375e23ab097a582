//! Owns which array of a file plays which part, where the experiment does not say: the names that laboratories and public data sets
//! use.

use super::Keys;

/// Other names of the masks, the most telling first.
const MASK: &[&str] = &["masks", "mask3d", "mask_3d", "phi", "mask_real", "sensing_matrix", "h", "c"];
/// Of the measurements.
const MEAS: &[&str] =
    &["meas_real", "meas_bayer", "measurement", "measurements", "snapshot", "snapshots", "coded", "y"];
/// Of the truth.
const ORIG: &[&str] = &["orig_real", "original", "truth", "ground_truth", "gt", "x", "video"];
const RGB: &[&str] = &["orig_rgb", "truth_rgb"];

/// The name under which `names` hold a part; it is `key` unless that is the program's own and not there.
///
/// Capitals make no difference then, nor does a struct or group around it, unless there are several.
fn name_of(key: &str, own: &str, others: &[&str], names: &[String]) -> Option<String> {
    if names.iter().any(|n| n == key) {
        return Some(key.to_owned());
    }
    if key != own {
        return None;
    }
    [own].iter().chain(others).find_map(|wanted| {
        let plain = names.iter().find(|n| n.eq_ignore_ascii_case(wanted));
        let mut inner =
            names.iter().filter(|n| n.rsplit_once('.').is_some_and(|(_, m)| m.eq_ignore_ascii_case(wanted)));
        plain.or_else(|| inner.next().filter(|_| inner.next().is_none())).cloned()
    })
}

/// The names of the parts in a file that holds `names`. What is not there keeps its own name.
pub(super) fn resolved(keys: &Keys, names: &[String]) -> Keys {
    let own = Keys::default();
    let part =
        |key: &str, own: &str, others: &[&str]| name_of(key, own, others, names).unwrap_or_else(|| key.to_owned());
    Keys {
        mask: part(&keys.mask, &own.mask, MASK),
        meas: part(&keys.meas, &own.meas, MEAS),
        orig: part(&keys.orig, &own.orig, ORIG),
        rgb: part(&keys.rgb, &own.rgb, RGB),
    }
}

/// The parts in the order of [`Keys::all`]: their own names, which are those of their keys in `data.keys` too, and what they are.
const PARTS: [(&str, &str); 4] =
    [("mask", "the masks"), ("meas", "the measurements"), ("orig", "the truth"), ("rgb", "the truth in color")];

/// A name that the experiment gives to a part and a file lacks, and the part: to go on with another would be to solve something else.
pub(super) fn lacking<'k>(keys: &'k Keys, names: &[String], masks_elsewhere: bool) -> Option<(&'k str, &'static str)> {
    let parts = keys.all().into_iter().zip(PARTS).skip(usize::from(masks_elsewhere));
    let mut given = parts.filter(|(key, (own, _))| key != own);
    given.find(|(key, _)| !names.iter().any(|name| name == key)).map(|(key, (_, what))| (key, what))
}

/// What is to be said about names that were found in the place of others.
pub(super) fn notes(keys: &Keys, found: &Keys) -> Vec<String> {
    let renamed = keys.all().into_iter().zip(found.all()).zip(PARTS).filter(|((key, found), _)| key != found);
    renamed
        .map(|((key, found), (part, what))| {
            format!("there is no `{key}`: `{found}` is taken for {what}; data.keys.{part} names another")
        })
        .collect()
}

/// Of the names that are there, the one that is most likely meant by `key`.
pub(super) fn suggestion(key: &str, present: &[String], own: &Keys) -> Option<String> {
    let others = [(&own.mask, MASK), (&own.meas, MEAS), (&own.orig, ORIG), (&own.rgb, RGB)];
    let lower = key.to_ascii_lowercase();
    let (own, others) = others
        .into_iter()
        .find(|(own, others)| own.as_str() == lower || others.contains(&lower.as_str()))
        .map_or((key, &[][..]), |(own, others)| (own.as_str(), others));
    let distance = |name: &&String| strsim::damerau_levenshtein(&name.to_ascii_lowercase(), &lower);
    // What plays one part is not meant by another.
    let plays = |name: &str| PARTS.iter().any(|(own, _)| *own == name);
    let meant = |name: &&String| !(plays(key) && plays(name));
    let close = || present.iter().filter(meant).min_by_key(distance).filter(|name| distance(name) <= 2);
    name_of(own, own, others, present).or_else(|| close().cloned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|n| (*n).to_owned()).collect()
    }

    #[test]
    fn names_that_people_use_are_found_and_said() {
        for (there, mask, meas, orig) in [
            (&["Phi", "y", "x"][..], "Phi", "y", "x"),
            (&["mask3d", "meas_real"], "mask3d", "meas_real", "orig"),
            (&["Mask", "Y", "H", "gt"], "Mask", "Y", "gt"),
            (&["H", "y"], "H", "y", "orig"),
            (&["data", "data.mask", "data.meas"], "data.mask", "data.meas", "orig"),
            (&["mask", "Phi", "meas", "y"], "mask", "meas", "orig"),
        ] {
            let keys = resolved(&Keys::default(), &names(there));
            let notes = notes(&Keys::default(), &keys);
            assert_eq!((&*keys.mask, &*keys.meas, &*keys.orig), (mask, meas, orig), "{there:?}");
            let renamed = [(mask, "mask"), (meas, "meas"), (orig, "orig")].iter().filter(|(a, b)| a != b).count();
            assert_eq!(notes.len(), renamed, "{notes:?}");
        }
    }

    #[test]
    fn a_name_that_is_given_is_not_guessed_but_another_suggested() {
        let given = Keys { mask: "maks".into(), ..Keys::default() };
        let there = names(&["mask", "a.mask", "b.mask"]);
        assert_eq!(resolved(&given, &there).mask, "maks");
        assert_eq!(lacking(&given, &there, false), Some(("maks", "the masks")));
        assert_eq!((lacking(&given, &there, true), lacking(&Keys::default(), &there, false)), (None, None));
        assert_eq!(suggestion("maks", &there, &Keys::default()).as_deref(), Some("mask"));
        assert_eq!(suggestion("mask", &names(&["a", "Phi"]), &Keys::default()).as_deref(), Some("Phi"));
        assert_eq!(suggestion("mask", &names(&["depth"]), &Keys::default()), None);
        assert_eq!(suggestion("meas", &names(&["mask"]), &Keys::default()), None);
    }
}
