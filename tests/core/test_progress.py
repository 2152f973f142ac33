"""Reports of progress."""

from tint_sumo.core.progress import Progress, part_of


def test_shares_are_shown_in_percent_and_other_measures_as_numbers() -> None:
    assert Progress(100, 100, "step", {"success": 1.0, "loss": 1 / 3}).outcomes == "success 100%, loss 0.333"


def test_a_part_of_some_work_counts_from_where_it_begins() -> None:
    reported: list[Progress] = []
    part_of(reported.append, 30, 200)(Progress(5, 10, "case", {"success": 1.0}))
    assert reported == [Progress(35, 200, "case", {"success": 1.0})]
