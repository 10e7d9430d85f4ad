//! The command line of `palpate`.

mod cli;

fn main() -> std::process::ExitCode {
    cli::run()
}
