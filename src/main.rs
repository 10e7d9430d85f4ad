//! The command line of `palpate`.

fn main() {}
