from simtrack.benchmarks.envs import ASKED, run
from simtrack.benchmarks.harness import Options


def test_a_step_is_split_into_what_it_is_spent_on() -> None:
    result = run(Options(quick=True))
    for mode in ASKED:
        rows = [row for row in result.rows if f", {mode}: " in row.name]
        rate, parts = rows[0], rows[1:]
        assert rate.value is not None and rate.timing is not None and len(parts) == 3
        assert abs(sum(row.value or 0.0 for row in parts) - 1e3 * rate.timing.cpu) < 1e-6
    (growth,) = [row for row in result.rows if row.name.endswith("memory, second half to first")]
    assert growth.met
