"""A skip that nobody expects fails."""

import pytest
import skips

pytest_plugins = "pytester"


@pytest.fixture
def outcomes(pytester):
    """How tests of a file ended that runs with our hooks."""
    pytester.makeconftest("from skips import *")

    def run(source):
        pytester.makepyfile(source)
        return pytester.runpytest_inprocess("-p", "no:xdist", "-p", "no:cacheprovider")

    return run


@pytest.mark.parametrize("reason", [f"{skips.EXPECTED[0]} is not installed", "no reason"])
def test_only_an_expected_skip_passes(outcomes, reason):
    found = outcomes(f"""
        import pytest

        def test_in_a_test():
            pytest.skip({reason!r})

        @pytest.mark.skip(reason={reason!r})
        def test_by_a_mark():
            pass

        @pytest.mark.xfail
        def test_that_fails():
            assert False
    """)
    if reason != "no reason":
        found.assert_outcomes(skipped=2, xfailed=1)
    else:
        found.assert_outcomes(failed=1, errors=1, xfailed=1)
        found.stdout.fnmatch_lines("skipped: 'no reason': must begin as one of tests/skips.py does")


@pytest.mark.parametrize("package", [skips.EXPECTED[0], "another"])
def test_a_file_is_only_skipped_where_that_is_expected(outcomes, package):
    found = outcomes(f"""
        import pytest

        pytest.importorskip("no_such_package", reason={package!r} + " is not installed")
    """)
    found.assert_outcomes(**{"errors" if package == "another" else "skipped": 1})
