//! `sci gather`: the shards of a run, solved on several machines, become its results.

use std::path::PathBuf;

use super::{Done, check_folder, results};
use crate::run_folder::{Missing, RECORD, Shards};
use crate::shard::ranges;

/// Arguments of `sci gather`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The folder that all shards were given as --out
    #[arg(value_name = "DIR")]
    dir: PathBuf,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let dir = self.dir.display();
        check_folder(&self.dir)?;
        let Some(shards) = Shards::of(&self.dir)? else {
            anyhow::ensure!(
                self.dir.join(RECORD).exists(),
                "{dir}: no shards of a run are there; sci run CONFIG --out {dir} --shard 1/N makes the first of N"
            );
            outln!("nothing is left to gather: {dir} holds the results of a run");
            return Ok(Done::Complete);
        };
        let (missing, count) = (shards.missing(), shards.count());
        missing.iter().for_each(|missing| eprintln!("{}", line(missing)));
        anyhow::ensure!(
            missing.is_empty(),
            "{dir}: {} of {count} shards {} missing; nothing was written",
            missing.len(),
            if missing.len() == 1 { "is" } else { "are" }
        );
        shards.warnings().iter().for_each(|warning| eprintln!("warning: {warning}"));
        let Some(mut joined) = shards.join() else { anyhow::bail!("{dir}: its shards have no measurements") };
        outln!("joining {} measurements of {count} shards", joined.record.measurements.len());
        results::write(&mut joined.folder, &joined.layout, &joined.record)?;
        joined.folder.close()?;
        results::announce(&joined.record, &self.dir);
        results::verdict(&joined.record, &self.dir)?;
        Ok(Done::Complete)
    }
}

fn line(missing: &Missing) -> String {
    let Missing { shard, measurements, at_work, command } = missing;
    let what = match measurements.as_slice() {
        [] => "its measurements are solved, but not its pictures".to_owned(),
        [only] => format!("measurement {only} is not solved"),
        several => format!("measurements {} are not solved", ranges(several)),
    };
    match at_work {
        true => format!("shard {shard} is at work: {what}"),
        false => format!("shard {shard} is missing: {what}; make it with\n  {command}"),
    }
}
