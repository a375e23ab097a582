//! A run in the tasks of a job array of a real Slurm, on the loopback of this machine, with the file that we hand out.
#![cfg(unix)]

use std::fs;
use std::net::TcpListener;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use e2e::{Bench, assert_same, sci, wait_for, workspace};

/// Programs of Slurm that wait for work, gone with the test.
struct Cluster<'b> {
    bench: &'b Bench,
    programs: Vec<Child>,
}

/// Where a program is; those of the system's administrator are not on everyone's path.
fn program(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let folders = std::env::split_paths(&path).chain(["/usr/sbin".into(), "/sbin".into()]);
    folders.map(|folder| folder.join(name)).find(|path| path.is_file())
}

fn text(command: &mut Command) -> Result<String, String> {
    let output = command.output().map_err(|e| e.to_string())?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().to_owned();
    if output.status.success() { Ok(text(&output.stdout)) } else { Err(text(&output.stderr)) }
}

/// Asks until the answer is yes.
#[track_caller]
fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !is_so() {
        assert!(begin.elapsed() < Duration::from_secs(180), "{what} takes too long");
        std::thread::sleep(Duration::from_millis(100));
    }
}

impl<'b> Cluster<'b> {
    /// One node, this machine; nothing where Slurm is not installed.
    fn start(bench: &'b Bench) -> Option<Self> {
        let names = ["munged", "slurmctld", "slurmd", "sbatch"];
        let [Some(munged), Some(controller), Some(node), Some(_)] = names.map(program) else {
            test_data::skip("Slurm is not installed (Debian's slurmctld, slurmd, slurm-client and munge)");
            return None;
        };
        for folder in ["slurm", "slurm/state", "slurm/spool"] {
            fs::create_dir(bench.path(folder)).unwrap();
        }
        bench.write("slurm/key", (0..128).map(|i| (i * 37 + 11) as u8).collect::<Vec<_>>());
        bench.write("slurm/slurm.conf", Self::conf(bench));
        let mut cluster = Self { bench, programs: Vec::new() };
        let option = |name: &str, file: &str| format!("--{name}={}", bench.path("slurm").join(file).display());
        let mut key = Command::new("chmod");
        assert!(key.arg("600").arg(bench.path("slurm/key")).status().unwrap().success());
        cluster.spawn(Command::new(munged).args(["--foreground", "--force"]).args([
            option("socket", "socket"),
            option("key-file", "key"),
            option("pid-file", "munged.pid"),
            option("log-file", "munged.log"),
            option("seed-file", "seed"),
        ]));
        wait_for(&bench.path("slurm/socket"));
        cluster.spawn(Command::new(controller).arg("-D"));
        cluster.spawn(Command::new(node).arg("-D"));
        wait_until("the start of Slurm", || {
            cluster.ask("sinfo", &["-h", "-o", "%T"]).is_ok_and(|state| state == "idle")
        });
        Some(cluster)
    }

    fn conf(bench: &Bench) -> String {
        let folder = bench.path("slurm").display().to_string();
        let (host, user) =
            (text(Command::new("hostname").arg("-s")).unwrap(), text(Command::new("id").arg("-un")).unwrap());
        // Free a moment ago; taken together, so that they differ.
        let ports = [0; 2].map(|_| TcpListener::bind("127.0.0.1:0").unwrap());
        let [controller, node] = ports.map(|port| port.local_addr().unwrap().port());
        format!(
            "ClusterName=test\nSlurmctldHost={host}(127.0.0.1)\nSlurmUser={user}\nSlurmdUser={user}\n\
             SlurmctldPort={controller}\nSlurmdPort={node}\nAuthType=auth/munge\nAuthInfo=socket={folder}/socket\n\
             StateSaveLocation={folder}/state\nSlurmdSpoolDir={folder}/spool\nSlurmctldPidFile={folder}/slurmctld.pid\n\
             SlurmdPidFile={folder}/slurmd.pid\nSlurmctldLogFile={folder}/slurmctld.log\nSlurmdLogFile={folder}/slurmd.log\n\
             ProctrackType=proctrack/pgid\nTaskPlugin=task/none\nSelectType=select/cons_tres\n\
             SelectTypeParameters=CR_Core\nMpiDefault=none\nSchedulerParameters=batch_sched_delay=0,sched_interval=1\n\
             NodeName={host} NodeAddr=127.0.0.1 CPUs=2\nPartitionName=all Nodes=ALL Default=YES\n"
        )
    }

    fn command(&self, program: &str) -> Command {
        let path = format!("{}:{}", sci().parent().unwrap().display(), std::env::var("PATH").unwrap());
        let mut command = Command::new(program);
        command
            .current_dir(self.bench.path(""))
            .env("PATH", path)
            .env("SLURM_CONF", self.bench.path("slurm/slurm.conf"));
        command
    }

    fn spawn(&mut self, program: &mut Command) {
        let conf = self.bench.path("slurm/slurm.conf");
        self.programs
            .push(program.env("SLURM_CONF", conf).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    }

    fn ask(&self, program: &str, arguments: &[&str]) -> Result<String, String> {
        text(self.command(program).args(arguments))
    }
}

impl Drop for Cluster<'_> {
    fn drop(&mut self) {
        let _ = self.ask("scancel", &["--state=RUNNING"]);
        for program in self.programs.iter_mut().rev() {
            let _ = Command::new("kill").arg(program.id().to_string()).status();
            let _ = program.wait();
        }
    }
}

#[test]
fn a_job_array_of_which_a_task_is_killed_and_requeued_makes_what_one_process_makes() {
    let bench = Bench::new();
    let Some(cluster) = Cluster::start(&bench) else { return };
    let config = format!(
        "[data]\nkind = \"simulate\"\npath = '{}'\nmeasurements = [0, 1, 2]\n[data.mask]\nkind = \"random\"\nframes = 8\ndensity = 0.5\n\
         [solver]\nkind = \"gap\"\n[denoiser]\nkind = \"tv\"\n[[stage]]\niterations = 600\n",
        workspace().join("configs/demo/bunny").display()
    );
    bench.write("a.toml", config);
    let whole = bench.sci(&["run", "a.toml", "--out", "whole", "--threads", "1"]);
    assert_eq!(whole.code, 0, "{}", whole.stderr);

    let file = workspace().join("docs/cluster/sci.sbatch").display().to_string();
    let small = ["--cpus-per-task=1", "--mem=0", "--time=10"];
    let of_sci = ["--array=0-1", file.as_str(), "a.toml", "--out", "out"];
    let job = cluster.ask("sbatch", &[&["--parsable"], &small[..], &of_sci[..]].concat()).unwrap();
    let task = format!("{job}_0");
    wait_for(&bench.path("out/.sci-run/shard-1-of-2/m00"));
    cluster.ask("scancel", &["--signal=KILL", "--full", &task]).unwrap();
    let log = || fs::read_to_string(bench.path(&format!("sci-{task}.log"))).unwrap_or_default();
    wait_until("the array", || {
        let ended = cluster.ask("squeue", &["-h", "-j", &job]).is_ok_and(|left| left.is_empty());
        let again = log().contains("going on");
        if ended && !again {
            // While a task is on its way to its end, this is refused, or forgotten.
            let _ = cluster.ask("scontrol", &["requeue", &task]);
        }
        // Slurm would let two minutes pass before it starts a task again.
        let _ = cluster.ask("scontrol", &["update", &format!("JobId={task}"), "StartTime=now"]);
        ended && again
    });

    let log = log();
    assert!(log.contains("shard 1/2, as this is a task") && log.contains("going on: 1 of 2"), "{log}");
    let gathered = bench.sci(&["gather", "out"]);
    assert_eq!(gathered.code, 0, "{}{log}", gathered.stderr);
    assert_same(&bench.path("out"), &bench.path("whole"));
}
