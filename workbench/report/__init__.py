"""Self-contained HTML reports of banks and measurements: tables, figures with captions, provenance."""

from workbench.report.bank import write_bank_report
from workbench.report.measurement import write_measurement_report

__all__ = ["write_bank_report", "write_measurement_report"]
