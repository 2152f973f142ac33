from tint_sumo.study.tables import markdown_table


def test_columns_align_and_the_first_line_is_the_header() -> None:
    assert markdown_table([["method", "P"], ["ttc", "0.25"], ["no labels", ""]]).splitlines() == [
        "| method    | P    |",
        "| --------- | ---- |",
        "| ttc       | 0.25 |",
        "| no labels |      |",
    ]
