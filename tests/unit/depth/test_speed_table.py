import math

from workbench.bench.speed import speed_table


def test_one_run_times_all_contenders_and_compares_their_results() -> None:
    rows = {row.name: row for row in speed_table((90, 120), psf_size=15, iterations=3, repeats=2)}
    assert list(rows) == ["ours", "ours, dark borders", "bare transforms", "scikit-image"]
    assert rows["ours, dark borders"].largest_difference < 1e-4
    assert math.isnan(rows["ours"].largest_difference)
    assert rows["bare transforms"].times_floor == 1
    assert rows["scikit-image"].speed_up == 1
    assert all(0 < row.fastest_s <= row.median_s for row in rows.values())
