"""What is made from the raw data of experiments: summary, claims, figures and the page."""

from rce_fleet.experiments.report.page import make_report, read_second

__all__ = ["make_report", "read_second"]
