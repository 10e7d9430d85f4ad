//! Switches mechanisms off one at a time, for `benches/ablation`.

/// Whether a mechanism is at work: always, but for those that the environment's `PALPATE_WITHOUT`
/// names (separated by commas) in a build with the feature `ablation`.
pub(crate) fn is_on(mechanism: &str) -> bool {
    !cfg!(feature = "ablation")
        || !std::env::var("PALPATE_WITHOUT").is_ok_and(|off| off.split(',').any(|name| name == mechanism))
}
