"""Tables as HTML and Markdown; scores written and read back."""

import json
import math

from rich.table import Table

from mwdn.evaluation import Scores
from mwdn.evaluation.tables import html_table, markdown_table


def table():
    made = Table("method", title="x < y")
    made.add_column("a | b", justify="right")
    made.add_row("one & two", "[bold]1.5[/bold] \\[1, 2]")
    made.add_row("three", "0.5")
    return made


def test_html():
    assert html_table(table()) == (
        '<table><caption>x &lt; y</caption><tr><th class="left">method</th><th>a | b</th></tr>'
        "<tr><th>one &amp; two</th><td><b>1.5</b> [1, 2]</td></tr><tr><th>three</th><td>0.5</td></tr></table>"
    )


def test_markdown():
    assert markdown_table(table()).splitlines() == [
        "*x < y*",
        "",
        "| method | a \\| b |",
        "| --- | ---: |",
        "| one & two | **1.5** [1, 2] |",
        "| three | 0.5 |",
    ]


def test_scores_survive_json():
    scores = Scores({"psnr": (20.0, 21.5), "lpips": (math.nan, math.nan)}, (0.1, 0.2), None, "cpu", 7)
    result = Scores.read(json.loads(json.dumps(scores.content(), allow_nan=False)))
    assert result.values["psnr"] == scores.values["psnr"]
    assert all(map(math.isnan, result.values["lpips"]))
    assert (result.seconds, result.peak_bytes, result.device, result.learnable) == ((0.1, 0.2), None, "cpu", 7)
