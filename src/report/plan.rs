//! report.html, summary.json and the sentences of `palpate plan`.
