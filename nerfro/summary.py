"""`python -m nerfro.summary runs=[outputs]`: compare many runs in tables and in a report.

Examples:
    nerfro summary 'runs=[outputs]'
    nerfro summary 'runs=[outputs/first,outputs/straight]' out=outputs/report report=true
"""

from __future__ import annotations

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.report.summary import SummaryConfig, summarize


@entry_point("summary", SummaryConfig)
def main(options: SummaryConfig) -> None:
    """Read and compare runs, and print and write the result."""
    summarize(options)


if __name__ == "__main__":
    main()
