"""The small project of the pages, whose verdicts are asked here."""

from tests.report.conftest import populated, project

__all__ = ["populated", "project"]
