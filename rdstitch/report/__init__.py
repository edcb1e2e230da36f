"""A report of a result as one HTML page, made from the result alone; each section is a file."""

from rdstitch.report.page import report_page, write_report

__all__ = ["report_page", "write_report"]
