//! Every solver on inputs that no one should have, and on some that everyone has: each case must end with a finite result
//! that explains the measurement, or as `Diverged`; never with a panic, a NaN or a garbage video without a word.
//!
//! The table is printed one JSON object a line, which `cargo xtask stress` renders.

use admm::*;
use ndarray::{Array2, Array3, ArrayView4, ArrayViewMut4, Axis};
use sci_forward::bayer::{CfaPattern, Malvar};
use sci_forward::metrics::{mean_over_frames, psnr};
use sci_forward::testing::{gaussian, moving_square, uniform};
use sci_forward::{MaskOperator, MaskStack, Measurement, Noise, SensingOperator, VideoShape};
use std::sync::Arc;

const SHAPE: VideoShape = VideoShape { frames: 8, height: 32, width: 36 };

/// Pulls every frame towards its mean, the more the greater σ: a prior whose strength is σ.
struct Flatten;

impl Denoiser for Flatten {
    fn name(&self) -> &str {
        "flatten"
    }
    fn denoise(
        &mut self,
        call: &Call<'_>,
        x: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let sigma = call.required_sigma()?;
        let pull = sigma / (1.0 + sigma);
        for (x, mut out) in x.outer_iter().zip(out.outer_iter_mut()) {
            let mean = x.mean().unwrap_or(0.0);
            out.zip_mut_with(&x, |out, &x| *out = x + pull * (mean - x));
        }
        Ok(())
    }
}

/// A prior, fresh for each run.
type MakePrior = Box<dyn Fn() -> Box<dyn Denoiser>>;

fn tv(weight: f32) -> MakePrior {
    Box::new(move || Box::new(Tv::new(weight)))
}

type Disturb = Box<dyn Fn(&mut Array2<f32>)>;

/// What is solved, and how.
struct Case {
    name: String,
    masks: Result<MaskStack, sci_forward::MaskError>,
    truth: Array3<f32>,
    /// What happens to the measurement on its way.
    disturb: Disturb,
    /// Which pixels are measured; all if nothing.
    measured: Option<Array2<bool>>,
    start: From,
    prior: MakePrior,
    params: Params,
    plan: Plan,
    ends: Ends,
}

/// How a case has to end with every solver. A PSNR is in dB with the truth's peak as white; below it a result is garbage.
#[derive(Clone, Copy, Debug)]
enum Ends {
    /// With a result of at least so many dB.
    Result(f64),
    /// With a result of at least so many dB, diverged or refused.
    Somehow(f64),
    Diverged,
    Refused,
}

impl Ends {
    /// What is wrong with an ending.
    fn fault(self, ending: &Ending) -> Option<String> {
        match (self, ending) {
            (_, Ending::Fault(why)) => Some(why.clone()),
            (Self::Result(least) | Self::Somehow(least), Ending::Result { psnr, .. }) => {
                (psnr.is_nan() || *psnr < least).then(|| format!("{psnr:.1} dB, not {least:.1}"))
            }
            (Self::Somehow(_), _) | (Self::Diverged, Ending::Diverged { .. }) | (Self::Refused, Ending::Refused(_)) => {
                None
            }
            _ => Some(format!("{}, expected {self:?}", ending.cell())),
        }
    }
}

#[derive(Clone, Copy)]
enum From {
    Mean,
    Adjoint,
    Constant(f32),
    Random,
}

#[derive(Clone, Copy)]
struct Params {
    rho: f32,
    tau: f32,
    gamma: f32,
}

impl Case {
    /// Nothing unusual: the base that every case changes one thing of.
    fn base(name: impl Into<String>, shape: VideoShape) -> Self {
        Self {
            name: name.into(),
            masks: MaskStack::random(shape, 0.5, 3),
            truth: moving_square(shape),
            disturb: Box::new(|_| ()),
            measured: None,
            start: From::Mean,
            prior: tv(0.1),
            params: Params { rho: 1.0, tau: 100.0, gamma: 0.01 },
            plan: Plan::new([Stage { sigma: Some(0.05), iterations: 40 }]),
            ends: Ends::Somehow(5.0),
        }
    }

    fn masks(mut self, masks: Array3<f32>) -> Self {
        self.masks = MaskStack::new(masks);
        self
    }

    /// What is measured; or why it is refused.
    fn measurement(&self) -> Result<Measurement, String> {
        let masks = self.masks.clone().map_err(|e| e.to_string())?;
        let h = Arc::new(MaskOperator::new(masks));
        let mut y = h.forward(self.truth.view());
        (self.disturb)(&mut y);
        let whole = Measurement::new(h, y).map_err(|e| e.to_string())?;
        match &self.measured {
            Some(measured) => whole.restricted(measured.view()).map_err(|e| e.to_string()),
            None => Ok(whole),
        }
    }

    /// What can be asked of the result then is for [`Case::ends`].
    fn disturb(mut self, disturb: impl Fn(&mut Array2<f32>) + 'static) -> Self {
        self.disturb = Box::new(disturb);
        self
    }

    fn ends(mut self, ends: Ends) -> Self {
        self.ends = ends;
        self
    }

    /// As good as if nothing had been unusual.
    fn harmless(self) -> Self {
        self.at_least(15.0)
    }

    /// What every solver reached, less a decibel.
    fn at_least(self, decibels: f64) -> Self {
        self.ends(Ends::Result(decibels))
    }
}

#[derive(Clone, Copy, PartialEq, Debug)]
enum Which {
    GapPlain,
    Gap,
    GapReference,
    Admm,
    TwoStage,
    TwoStageScaled,
    ClosedForm,
}

const SOLVERS: [(Which, &str); 7] = [
    (Which::GapPlain, "GAP"),
    (Which::Gap, "GAP accelerated"),
    (Which::GapReference, "GAP reference"),
    (Which::Admm, "ADMM"),
    (Which::TwoStage, "two-stage"),
    (Which::TwoStageScaled, "two-stage scaled"),
    (Which::ClosedForm, "two-stage CFD"),
];

/// How a case ended.
#[derive(Debug, Clone, PartialEq)]
enum Ending {
    Result { psnr: f64, residual: f64 },
    Diverged { iteration: usize },
    Refused(String),
    Fault(String),
}

impl Ending {
    fn cell(&self) -> String {
        match self {
            Self::Result { psnr, residual } if psnr.is_infinite() => format!("exact, {residual:.1e}"),
            Self::Result { psnr, residual } => format!("{psnr:.1} dB, {residual:.1e}"),
            Self::Diverged { iteration } => format!("diverged at {iteration}"),
            Self::Refused(why) => format!("refused: {why}"),
            Self::Fault(why) => format!("FAULT: {why}"),
        }
    }
}

fn solve(case: &Case, which: Which) -> Ending {
    let quiet = std::panic::AssertUnwindSafe(|| attempt(case, which));
    std::panic::catch_unwind(quiet).unwrap_or_else(|_| Ending::Fault("panicked".into()))
}

fn attempt(case: &Case, which: Which) -> Ending {
    let measurement = match case.measurement() {
        Ok(measurement) => measurement,
        Err(refused) => return Ending::Refused(refused),
    };
    match recover(case, which, &measurement) {
        Err(e) => Ending::Refused(std::error::Error::source(&e).map_or(e.to_string(), |s| format!("{e}: {s}"))),
        Ok(outcome) => judge(case, &outcome),
    }
}

fn judge(case: &Case, outcome: &Outcome) -> Ending {
    let (estimate, residual) = (&outcome.estimate.sensor, outcome.relative_residual);
    if let Some(v) = estimate.iter().find(|v| !v.is_finite()) {
        return Ending::Fault(format!("{v} in the estimate"));
    }
    if outcome.stop == StopReason::Diverged {
        return Ending::Diverged { iteration: outcome.iterations - 1 };
    }
    if residual.is_nan() || residual > 1.0 {
        return Ending::Fault(format!("residual {residual:.1e}: a black video explains the measurement better"));
    }
    let white = case.truth.iter().fold(0f32, |m, &v| m.max(v));
    let psnr = mean_over_frames((&case.truth / white).view(), (estimate / white).view(), psnr);
    Ending::Result { psnr, residual }
}

fn recover(case: &Case, which: Which, measurement: &Measurement) -> Result<Outcome, SolveError> {
    let given = match case.start {
        From::Constant(v) => Array3::from_elem(case.truth.dim(), v),
        _ => gaussian(case.truth.dim(), 5),
    };
    let start = match case.start {
        From::Mean => Start::Mean,
        From::Adjoint => Start::Adjoint,
        From::Constant(_) | From::Random => Start::From(given.view()),
    };
    let Params { rho, tau, gamma } = case.params;
    let two_stage = |convention, x_step| -> Box<dyn Solver> {
        let params = TwoStageParams { rho, tau, convention };
        Box::new(TwoStage::new((case.prior)(), Malvar, x_step, CfaPattern::Rggb, params))
    };
    let prior = (case.prior)();
    let mut solver: Box<dyn Solver> = match which {
        Which::GapPlain => Box::new(Gap::plain(prior)),
        Which::Gap => Box::new(Gap::accelerated(prior)),
        Which::GapReference => Box::new(Gap::with_momentum(prior, MomentumStart::Zero)),
        Which::Admm => Box::new(Admm::new(prior, gamma)),
        Which::TwoStage => two_stage(Convention::PaperCode, XStep::Demosaic),
        Which::TwoStageScaled => two_stage(Convention::Scaled, XStep::Demosaic),
        Which::ClosedForm => two_stage(Convention::PaperCode, XStep::ClosedForm { clip: true }),
    };
    run(solver.as_mut(), measurement, start, &case.plan, &mut ())
}

/// Runs every case with every solver, prints the table, and fails if there is a fault in it.
fn check(group: &str, cases: Vec<Case>) {
    let mut faults = Vec::new();
    for case in cases {
        for (which, solver) in SOLVERS {
            let ending = solve(&case, which);
            let fault = case.ends.fault(&ending);
            let cell = fault.as_ref().map_or_else(|| ending.cell(), |why| format!("FAULT: {why}")).replace('"', "'");
            println!(r#"{{"group":"{group}","case":"{}","solver":"{solver}","outcome":"{cell}"}}"#, case.name);
            faults.extend(fault.map(|why| format!("{group} / {} / {solver}: {why}", case.name)));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn masks() {
    let base = |name: &str| Case::base(name, SHAPE);
    let random = uniform(SHAPE.dim(), 9);
    let mut one_frame = Array3::zeros(SHAPE.dim());
    one_frame.index_axis_mut(Axis(0), 2).fill(1.0);
    let first = random.index_axis(Axis(0), 0).mapv(f32::round);
    let mut spike = random.mapv(|v| 0.1 + 0.9 * v);
    spike[[3, 5, 7]] = 1e6;
    check(
        "masks",
        vec![
            base("all 0").masks(Array3::zeros(SHAPE.dim())).ends(Ends::Refused),
            base("all 1").masks(Array3::ones(SHAPE.dim())),
            base("one frame open").masks(one_frame),
            base("the same in every frame").masks(first.broadcast(SHAPE.dim()).unwrap().to_owned()),
            base("float in [0, 1e-6]").masks(&random * 1e-6),
            base("float, one pixel 1e6").masks(spike),
            base("float in [0, 1e-20]").masks(&random * 1e-20).ends(Ends::Refused),
            base("float up to 1e25").masks(&random * 1e25).ends(Ends::Refused),
        ],
    );
}

#[test]
fn sizes() {
    let sizes = [(1, 32, 36), (2, 32, 36), (64, 16, 18), (8, 2, 2), (8, 3, 3), (8, 1, 4096), (8, 4096, 1), (2, 1, 1)];
    let case = |(frames, height, width)| {
        let masks = MaskStack::random(VideoShape { frames, height, width }, 0.5, 3);
        let mut case = Case::base(format!("{frames} × {height}×{width}"), VideoShape { frames, height, width });
        case.masks = masks.or(MaskStack::new(Array3::ones((frames, height, width))));
        case
    };
    check("size", sizes.into_iter().map(case).collect());
}

#[test]
fn measurements() {
    let base = |name: &str| Case::base(name, SHAPE);
    let pixels =
        |value: f32| move |y: &mut Array2<f32>| (0..12).for_each(|k| y[[(7 * k + 3) % 32, (11 * k + 5) % 36]] = value);
    let noise = |decibels: i32| {
        move |y: &mut Array2<f32>| {
            let power = y.mapv(|v| v * v).mean().unwrap();
            let sigma = (power / 10f32.powf(decibels as f32 / 10.0)).sqrt();
            *y = Noise::new(None, f64::from(sigma)).unwrap().apply(y.view(), 4);
        }
    };
    let photons =
        |photons: f64| move |y: &mut Array2<f32>| *y = Noise::new(Some(photons), 0.0).unwrap().apply(y.view(), 4);
    check(
        "measurement",
        vec![
            // A black video has 5.7 dB.
            base("black").disturb(|y| y.fill(0.0)).at_least(5.6),
            base("saturated at 1.5").disturb(|y| y.mapv_inplace(|v| v.min(1.5))).at_least(12.0),
            base("12 dead pixels").disturb(pixels(0.0)).at_least(16.0),
            base("12 hot pixels").disturb(pixels(8.0)).at_least(14.5),
            // Pixels that are believed are that far off, but no others may grow beyond them.
            base("12 pixels at 1e6").disturb(pixels(1e6)).at_least(-92.0),
            base("12 pixels at 1e30").disturb(pixels(1e30)).ends(Ends::Diverged),
            base("12 NaN pixels").disturb(pixels(f32::NAN)).ends(Ends::Refused),
            base("Gaussian noise, 20 dB").disturb(noise(20)).at_least(16.0),
            base("Gaussian noise, 0 dB").disturb(noise(0)).at_least(3.5),
            base("100 photons").disturb(photons(100.0)).at_least(16.0),
            base("1 photon").disturb(photons(1.0)).at_least(6.3),
            base("negative").disturb(|y| y.mapv_inplace(|v| -v)).ends(Ends::Somehow(-1.2)),
        ],
    );
}

/// Dead, hot and NaN pixels that are taken out of the masks do no harm.
#[test]
fn unmeasured_pixels() {
    let mut cases = Vec::new();
    for (name, value) in [("dead", 0.0), ("hot", 8.0), ("NaN", f32::NAN)] {
        let mut measured = Array2::from_elem(SHAPE.image_dim(), true);
        let bad: Vec<(usize, usize)> = (0..12).map(|k| ((7 * k + 3) % 32, (11 * k + 5) % 36)).collect();
        bad.iter().for_each(|&at| measured[at] = false);
        let mut case = Case::base(format!("12 {name} pixels, unmeasured"), SHAPE);
        case.measured = Some(measured);
        let case = case.disturb(move |y| {
            // A pixel that is not measured may hold anything finite; a NaN is replaced on reading.
            bad.iter().for_each(|&at| y[at] = if f32::is_nan(value) { 0.0 } else { value });
        });
        cases.push(case.harmless());
    }
    check("unmeasured", cases);
}

#[test]
fn parameters() {
    let mut cases = Vec::new();
    for v in [1e-8, 1e-4, 1e4, 1e8] {
        let base = |what: &str| Case::base(format!("{what} {v:.0e}"), SHAPE);
        let params = base("").params;
        cases.push(Case { prior: tv(v), ..base("TV weight") });
        cases.push(Case { params: Params { gamma: v, ..params }, ..base("γ") });
        cases.push(Case { params: Params { rho: v, ..params }, ..base("ρ") });
        cases.push(Case { params: Params { tau: v, ..params }, ..base("τ") });
        let plan = Plan::new([Stage { sigma: Some(v), iterations: 40 }]);
        cases.push(Case { prior: Box::new(|| Box::new(Flatten)), plan, ..base("σ") });
    }
    check("parameter", cases);
}

#[test]
fn long_runs_and_odd_starts() {
    let base = |name: &str| Case::base(name, SHAPE);
    let from = |name: &str, start| Case { start, ..base(name) };
    check(
        "run",
        vec![
            base("nothing unusual").harmless(),
            Case { plan: Plan::new([Stage { sigma: Some(0.05), iterations: 2000 }]), ..base("2,000 iterations") },
            Case { plan: Plan::new([]), ..base("no iteration") },
            from("start adjoint", From::Adjoint),
            from("start 0", From::Constant(0.0)),
            from("start 100", From::Constant(100.0)),
            from("start 1e8", From::Constant(1e8)),
            from("start 1e30", From::Constant(1e30)),
            from("start random", From::Random),
        ],
    );
}

/// A measurement `s` times as large, with priors `s` times as strong, gives the video times `s`.
#[test]
fn scales() {
    let solvers = &SOLVERS[..4];
    let mut faults = Vec::new();
    for (which, solver) in solvers {
        let estimate = |scale: f32| {
            let case = Case { prior: tv(0.1 * scale), ..Case::base("", SHAPE) };
            let h = Arc::new(MaskOperator::new(case.masks.clone().unwrap()));
            let scaled = Measurement::new(h.clone(), h.forward(case.truth.view()) * scale).unwrap();
            let outcome = recover(&case, *which, &scaled).unwrap();
            assert_eq!(outcome.stop, StopReason::ScheduleDone);
            outcome.estimate.sensor / scale
        };
        let one = estimate(1.0);
        for exponent in [-8, -4, 4, 8] {
            let off = (&one - estimate(10f32.powi(exponent))).fold(0f32, |m, d| m.max(d.abs()));
            let outcome = format!("off by {off:.1e}");
            println!(
                r#"{{"group":"scale","case":"y × 1e{exponent}, weight too","solver":"{solver}","outcome":"{outcome}"}}"#
            );
            if off > 1e-4 {
                faults.push(format!("{solver} × 1e{exponent}: {outcome}"));
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}
