//! Progress on a terminal, for what takes more than a second.

use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// What takes less than this shows nothing.
const PATIENCE: Duration = Duration::from_secs(1);

/// A bar or a spinner that appears after a second and leaves no trace. It stays hidden where standard error
/// is not a terminal.
pub struct Progress {
    bar: ProgressBar,
    /// Dropped to wake the thread that waits to show the bar.
    done: Option<Sender<()>>,
    shows: Option<JoinHandle<()>>,
}

impl Progress {
    /// Work of unknown length.
    pub fn spinner(text: &str) -> Self {
        Self::new(
            ProgressBar::new_spinner(),
            "{spinner} {msg} … {elapsed}",
            text.to_string(),
        )
    }

    /// Work of `length` steps; see [`Self::advance`].
    pub fn bar(text: &str, length: u64) -> Self {
        let style = "{msg} {wide_bar:.dim} {percent:>3} %, {eta} left";
        Self::new(ProgressBar::new(length), style, text.to_string())
    }

    fn new(bar: ProgressBar, template: &str, text: String) -> Self {
        bar.set_draw_target(ProgressDrawTarget::hidden());
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
        bar.set_message(text);
        let (done, waits) = channel::<()>();
        let later = bar.clone();
        let shows = std::thread::spawn(move || {
            if waits.recv_timeout(PATIENCE) == Err(RecvTimeoutError::Timeout) {
                later.set_draw_target(ProgressDrawTarget::stderr());
                later.enable_steady_tick(Duration::from_millis(200));
            }
        });
        Self {
            bar,
            done: Some(done),
            shows: Some(shows),
        }
    }

    /// `steps` are done.
    pub fn reach(&self, steps: u64) {
        self.bar.set_position(steps);
    }

    /// `steps` more are done.
    pub fn advance(&self, steps: u64) {
        self.bar.inc(steps);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        drop(self.done.take());
        if let Some(shows) = self.shows.take() {
            // It cannot panic, and there would be nothing to do about it.
            let _ = shows.join();
        }
        self.bar.finish_and_clear();
    }
}
