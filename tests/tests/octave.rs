//! `matlab/sci.m` in Octave, where that is installed: arrays in, frames and record out, and what `sci` says of mistakes.

use std::process::Command;

use e2e::{Bench, sci, workspace};

const PROGRAM: &str = r#"
[x, y] = meshgrid(1:32, 1:32);
for t = 1:4, video(:, :, t) = 60 + x + y + 80 * (hypot(x - 12 - 2 * t, y - 14 - t) < 7); end
rand('seed', 1); mask = double(rand(32, 32, 4) > 0.5); meas = sum(mask .* video, 3);
[frames, record] = sci(cat(3, meas, meas), mask, 'gray/gap-tv', 'denoiser.weight=0.2');
assert(size(frames), [32, 32, 8]);
psnr = 10 * log10(255 ^ 2 / mean((double(frames(:, :, 1:4))(:) - video(:)) .^ 2));
assert(psnr > 20, sprintf('%g dB', psnr));
assert(record.mean.iterations, 40);
try, sci(meas(1:20, :), mask); error('accepted'); catch e, disp(e.message); end
% A quote reaches sci as it is.
try, sci(meas, mask, 'gray/gap-tv', 'denoiser.kind="it''s"'); error('accepted'); catch e, disp(e.message); end
"#;

#[test]
fn the_function_for_matlab_works_in_octave() {
    let bench = Bench::new();
    bench.write("program.m", PROGRAM);
    let path = std::env::var_os("PATH").unwrap_or_default();
    let folders = [sci().parent().unwrap().to_owned()].into_iter().chain(std::env::split_paths(&path));
    let mut octave = Command::new("octave-cli");
    octave.current_dir(bench.path(".")).env_remove("SCI_DATA").env("PATH", std::env::join_paths(folders).unwrap());
    octave.env("TMPDIR", bench.path(".")).arg("--path").arg(workspace().join("matlab")).arg("program.m");
    if Command::new("octave-cli").arg("--version").output().is_err() {
        return test_data::skip("no octave-cli on the PATH");
    }
    let run = bench.finish(&mut octave);
    assert_eq!(run.code, 0, "{}{}", run.stdout, run.stderr);
    for part in ["`meas` is 20×32", "it's"] {
        assert!(run.stdout.contains(part), "{part}: {}", run.stdout);
    }
    assert_eq!(bench.names(), ["program.m"], "nothing is left in the folder for temporary files");
}
