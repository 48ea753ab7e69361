"""The command line: `morph build | info | track | live | ...`; one file a command."""

from morph_dslam.cli.app import main, run_and_report_errors

__all__ = ["main", "run_and_report_errors"]
