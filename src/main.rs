//! The command line of `palpate`.

use std::process::ExitCode;

fn main() -> ExitCode {
    let own = std::env::current_exe().map_or_else(|_| "palpate".into(), Into::into);
    ExitCode::from(palpate::cli::run(std::env::args_os().collect(), vec![own]))
}
