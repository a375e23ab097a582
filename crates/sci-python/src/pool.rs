//! Owns where work is done: on the worker threads, with the interpreter free, until it is done or the user stops it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
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

    pub(crate) fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Does `work` on a worker thread, as the `sci` command does: from outside, every parallel step would have to wake one first. This thread
/// waits and looks for signals, which Python delivers to its main thread only.
///
/// # Errors
/// What a signal raises, `KeyboardInterrupt` after Ctrl-C; `work` has then been told to stop, and has.
pub(crate) fn run<T: Send>(py: Python<'_>, work: impl FnOnce(&Stop) -> T + Send) -> PyResult<T> {
    let stop = Stop::default();
    // A denoiser in Python is called on a worker thread, which has to do what it asks for itself.
    if rayon::current_thread_index().is_some() {
        return Ok(py.detach(|| work(&stop)));
    }
    let (sender, receiver) = mpsc::channel();
    let stop = &stop;
    py.detach(move || {
        rayon::in_place_scope(|scope| {
            scope.spawn(move |_| {
                // The receiver waits until the end.
                let _ = sender.send(work(stop));
            });
            let mut signal = Ok(());
            loop {
                match receiver.recv_timeout(LOOK_EVERY) {
                    Ok(done) => return signal.map(|()| done),
                    Err(RecvTimeoutError::Timeout) => {
                        if let Err(raised) = Python::attach(|py| py.check_signals()) {
                            stop.set();
                            signal = Err(raised);
                        }
                    }
                    // The work panicked; the scope hands that on.
                    Err(RecvTimeoutError::Disconnected) => {
                        return Err(pyo3::exceptions::PyRuntimeError::new_err("the work ended without a result"));
                    }
                }
            }
        })
    })
}
