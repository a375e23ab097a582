//! Owns where work is done: on a thread of its own, with the interpreter free, until it is done or the user stops it.

use std::panic::resume_unwind;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use pyo3::prelude::*;

/// How long Ctrl-C may wait to be seen.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Whether work is to stop.
#[derive(Debug, Default)]
pub(crate) struct Stop(AtomicBool);

impl Stop {
    pub(crate) fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Does `work` while this thread waits and looks for signals, which Python delivers to its main thread only.
///
/// It is not done on a worker thread of rayon: that may take up other work where it has to wait, and would then wait for itself if both call
/// the same denoiser.
///
/// # Errors
/// What a signal raises, `KeyboardInterrupt` after Ctrl-C; `work` has then been told to stop, and has.
pub(crate) fn run<T: Send>(py: Python<'_>, work: impl FnOnce(&Stop) -> T + Send) -> PyResult<T> {
    let (stop, (sender, receiver)) = (&Stop::default(), mpsc::channel::<()>());
    py.detach(move || {
        thread::scope(|scope| {
            let worker = scope.spawn(move || {
                // Dropped at the end, however that comes: what the other side waits for.
                let _sender = sender;
                work(stop)
            });
            let mut signal = Ok(());
            while let Err(RecvTimeoutError::Timeout) = receiver.recv_timeout(LOOK_EVERY) {
                if let Err(raised) = Python::attach(|py| py.check_signals()) {
                    stop.0.store(true, Ordering::Relaxed);
                    signal = Err(raised);
                }
            }
            let done = worker.join().unwrap_or_else(|panic| resume_unwind(panic));
            signal.map(|()| done)
        })
    })
}
