//! No file, whatever is in it, makes loading or a query panic.

mod fuzz;

use std::time::Duration;

#[test]
fn mutated_files_are_refused_or_answer() {
    let folder = tempfile::tempdir().unwrap();
    let outcome = fuzz::run(1, Duration::from_secs(3), folder.path());
    assert_eq!(outcome.failures, [0; 0], "{outcome:?}");
    // Both what refuses and what queries rely on has been met.
    assert!(
        outcome.loaded > 10 && outcome.executions > outcome.loaded + 10,
        "{outcome:?}"
    );
}
