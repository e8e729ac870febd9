//! What can go wrong: one line for standard error, and an exit status.

use std::path::Path;
use std::process::ExitCode;

use clap::error::ErrorKind;

/// Result of a command or of a part of it.
pub type Result<T> = std::result::Result<T, Failure>;

/// A message that names the file or the parameter and says what to do, and its class.
#[derive(Debug)]
pub struct Failure {
    status: u8,
    message: String,
}

impl Failure {
    /// Wrong parameters: status 2.
    pub fn usage(message: impl Into<String>) -> Self {
        Self {
            status: 2,
            message: message.into(),
        }
    }

    /// Anything else: status 1.
    pub fn failed(message: impl Into<String>) -> Self {
        Self {
            status: 1,
            message: message.into(),
        }
    }

    /// A failure about a file: status 1.
    pub fn file(path: &Path, reason: impl std::fmt::Display) -> Self {
        Self::failed(format!("\"{}\": {reason}", path.display()))
    }

    /// Writes the line.
    pub fn report(&self) -> ExitCode {
        write_line(&self.message);
        ExitCode::from(self.status)
    }
}

/// Tells what does not keep a command from its result, in one line.
pub fn warn(message: &str) {
    write_line(&format!("warning: {message}"));
}

/// Names of files may hold anything; what would break the line or steer the terminal is replaced.
fn write_line(message: &str) {
    use std::io::Write;
    let line: String = message
        .chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect();
    // Nobody is left to be told when this fails.
    let _ = writeln!(std::io::stderr(), "glints: {line}");
}

impl From<glints::error::Error> for Failure {
    fn from(error: glints::error::Error) -> Self {
        match error {
            glints::error::Error::Parameter { .. } => Self::usage(error.to_string()),
            _ => Self::failed(error.to_string()),
        }
    }
}

/// Help and version are printed; an error becomes one line without the usage block.
pub fn from_clap(error: &clap::Error) -> Result<()> {
    match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => {
            return crate::output::print(&error.render().to_string());
        }
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            return Err(Failure::usage("no command given; see glints --help"));
        }
        _ => (),
    }
    let text = error.render().to_string();
    let told: Vec<&str> = text
        .lines()
        .map(str::trim)
        .take_while(|line| !line.starts_with("Usage:") && !line.starts_with("For more information"))
        .filter(|line| !line.is_empty())
        .collect();
    let message = told.join(" ");
    let message = message.strip_prefix("error: ").unwrap_or(&message);
    Err(Failure::usage(format!("{message}; see --help")))
}
