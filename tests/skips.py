"""Hooks of pytest that fail every skip but the expected ones, so that none goes unnoticed."""

import pytest

EXPECTED = (
    # Too large for the extra `test`, or from a nightly build.
    "rejax",
    "stable_baselines3",
    "sb3_contrib",
    "multivae",
    # Not a package of Python.
    "none of chromium",
    "Python 3.11 is not installed",
    "Python 3.12 is not installed",
    # Away from the source, or in a shallow clone.
    "the whole history",
)
"""How the reasons of expected skips begin."""


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report(collector):
    return _failed_unless_expected((yield))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item, call):
    return _failed_unless_expected((yield))


def _failed_unless_expected(report):
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2].removeprefix("Skipped: ")
        if not reason.startswith(EXPECTED):
            report.outcome = "failed"
            report.longrepr = f"skipped: {reason!r}: must begin as one of tests/skips.py does"
    return report
