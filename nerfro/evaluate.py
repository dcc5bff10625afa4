"""`python -m nerfro.evaluate checkpoint=RUN` or `predictions=DIR references=DIR`: score a model, or any images.

Examples:
    nerfro evaluate checkpoint=outputs/first split=val
    nerfro evaluate predictions=outputs/first/images references=data/test out=scores
"""

from __future__ import annotations

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.evaluation.request import EvaluateConfig
from nerfro.pipeline.evaluate import evaluate


@entry_point("evaluate", EvaluateConfig)
def main(options: EvaluateConfig) -> None:
    """Score the test views of a checkpoint, or a folder of images."""
    evaluate(options=options)


if __name__ == "__main__":
    main()
