//! Owns which measurements of a run a machine solves, where several machines share the run.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

/// One of the equal parts that a run is cut into: number `number` of `count`, counted from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Shard {
    number: usize,
    count: usize,
}

impl Shard {
    /// Nothing unless `number` is one of 1 to `count`.
    pub fn new(number: usize, count: usize) -> Option<Self> {
        (1..=count).contains(&number).then_some(Self { number, count })
    }

    /// All shards of a run that is cut into `count`.
    pub fn all(count: usize) -> impl Iterator<Item = Self> {
        (1..=count).map(move |number| Self { number, count })
    }

    /// Its number, from 1.
    pub fn number(self) -> usize {
        self.number
    }

    /// How many there are.
    pub fn count(self) -> usize {
        self.count
    }

    /// Its part of the measurements: consecutive ones, so that what a measurement takes over from the one before is cut as rarely
    /// as can be. Parts differ by one measurement at most, and the last are empty where there are more shards than measurements.
    pub fn part<T>(self, all: &[T]) -> &[T] {
        let (each, more) = (all.len() / self.count, all.len() % self.count);
        let begin = |before: usize| before * each + before.min(more);
        &all[begin(self.number - 1)..begin(self.number)]
    }

    /// The shard of a task of a Slurm job array, if there is an array of several tasks: its place among the numbers of the array,
    /// which may begin anywhere. `variable` looks up the environment.
    ///
    /// # Errors
    /// Names the variable that is missing or makes no sense.
    pub fn of_slurm(variable: impl Fn(&str) -> Option<String>) -> Result<Option<Self>, String> {
        const HINT: &str = "name the part with --shard I/N (--shard 1/1 solves all of the run)";
        let number = |name: &str| {
            let Some(text) = variable(name) else { return Ok(None) };
            let bad = |_| format!("{name} is {text:?}, expected a whole number; {HINT}");
            text.parse::<usize>().map(Some).map_err(bad)
        };
        let Some(task) = number("SLURM_ARRAY_TASK_ID")? else { return Ok(None) };
        let needed =
            |name: &str| number(name)?.ok_or_else(|| format!("SLURM_ARRAY_TASK_ID is set, but not {name}; {HINT}"));
        let (count, first) = (needed("SLURM_ARRAY_TASK_COUNT")?, needed("SLURM_ARRAY_TASK_MIN")?);
        let step = number("SLURM_ARRAY_TASK_STEP")?.unwrap_or(1).max(1);
        let place = task.checked_sub(first).filter(|above| above % step == 0).map(|above| above / step + 1);
        match place.and_then(|number| Self::new(number, count)) {
            Some(shard) => Ok(Some(shard).filter(|shard| shard.count > 1)),
            None => Err(format!(
                "SLURM_ARRAY_TASK_ID is {task}, expected one of {count} numbers from {first} in steps of {step}, as in \
                 --array=1-{count}; {HINT}"
            )),
        }
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.count)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        let Some((number, count)) = numbers else {
            return Err("expected I/N, part I of N, for example 2/3".into());
        };
        Self::new(number, count).ok_or_else(|| match count {
            0 => "expected I/N with N at least 1, for example 2/3".into(),
            _ => format!("expected I/{count} with I from 1 to {count}"),
        })
    }
}

/// Numbers as a person would list them: `0 to 3, 7`.
pub fn ranges(numbers: &[usize]) -> String {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for &n in numbers {
        match runs.last_mut() {
            Some(run) if run.end == n => run.end += 1,
            _ => runs.push(n..n + 1),
        }
    }
    let text = |run: &Range<usize>| match run.len() {
        1 => run.start.to_string(),
        2 => format!("{}, {}", run.start, run.end - 1),
        _ => format!("{} to {}", run.start, run.end - 1),
    };
    runs.iter().map(text).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_measurement_is_in_one_shard_and_shards_are_equal_but_for_one() {
        for measurements in 0..12 {
            let all: Vec<usize> = (0..measurements).collect();
            for count in 1..15 {
                let parts: Vec<&[usize]> = Shard::all(count).map(|shard| shard.part(&all)).collect();
                assert_eq!(parts.concat(), all, "{count} shards");
                let sizes = || parts.iter().map(|part| part.len());
                assert!(sizes().max().unwrap() - sizes().min().unwrap() <= 1 && sizes().rev().is_sorted(), "{parts:?}");
            }
        }
    }

    #[test]
    fn a_shard_is_told_as_part_of_a_number() {
        let shard: Shard = "2/3".parse().unwrap();
        assert_eq!((shard.number(), shard.count(), shard.to_string().as_str()), (2, 3, "2/3"));
        for (text, legal) in [("0/3", "1 to 3"), ("4/3", "1 to 3"), ("1/0", "at least 1"), ("2", "2/3"), ("a/b", "2/3")]
        {
            let error = text.parse::<Shard>().unwrap_err();
            assert!(error.contains(legal), "{text}: {error}");
        }
    }

    fn slurm(variables: &[(&str, &str)]) -> Result<Option<Shard>, String> {
        let value = |name: &str| variables.iter().find(|(n, _)| format!("SLURM_ARRAY_TASK_{n}") == name);
        Shard::of_slurm(|name| value(name).map(|(_, v)| (*v).to_owned()))
    }

    #[test]
    fn a_task_of_a_job_array_is_a_shard_wherever_the_array_begins() {
        let task = |id: &str, count: &str, first: &str, step: &str| {
            slurm(&[("ID", id), ("COUNT", count), ("MIN", first), ("STEP", step)])
        };
        assert_eq!(task("1", "3", "1", "1"), Ok(Shard::new(1, 3)));
        assert_eq!(task("0", "3", "0", "1"), Ok(Shard::new(1, 3)));
        assert_eq!(task("2", "3", "0", "1"), Ok(Shard::new(3, 3)));
        assert_eq!(task("30", "4", "0", "10"), Ok(Shard::new(4, 4)));
        // A single task has everything to do, and what is no task too.
        assert_eq!(task("7", "1", "7", "1"), Ok(None));
        assert_eq!(slurm(&[]), Ok(None));
        assert_eq!(slurm(&[("ID", "2"), ("COUNT", "2"), ("MIN", "1")]), Ok(Shard::new(2, 2)));
        for (wrong, said) in [
            (task("7", "3", "1", "1"), "is 7, expected one of 3"),
            (task("x", "3", "1", "1"), "SLURM_ARRAY_TASK_ID is \"x\""),
            (task("1", "3", "0", "2"), "in steps of 2"),
            (slurm(&[("ID", "1"), ("COUNT", "3")]), "not SLURM_ARRAY_TASK_MIN"),
        ] {
            let error = wrong.unwrap_err();
            assert!(error.contains(said) && error.contains("--shard"), "{error}");
        }
    }

    #[test]
    fn neighbours_are_listed_together() {
        assert_eq!(ranges(&[0, 1, 2, 3, 7, 9, 10]), "0 to 3, 7, 9, 10");
        assert_eq!(ranges(&[5, 4]), "5, 4");
        assert_eq!(ranges(&[]), "");
    }
}
