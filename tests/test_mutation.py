"""Mutants of small modules."""

from pathlib import Path

import mutation
import pytest

MODULE = Path("jaxsense/part/module.py")


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("def f(a):\n    return a < 2", {"(a <= 2)", "(a > 2)", "(a >= 2)", "(1)", "(3)"}),
        ("def f(a: X[2] = None) -> Y[2]:\n    return -a", {"(a)"}),
        ("a = 2\n\nclass B:\n    c: int = 3", set()),
        ("Kind = int | None", set()),
        ("def f(a):\n    '''Text.'''\n    chex.assert_rank(a, 1)\n    g(f'{a + 1}')", {"pass"}),
        ("if a:\n    b = c.replace(d=e, g=h)", {"(not a)", "(c.replace(d=e))", "(c.replace(g=h))"}),
        ("a += jnp.argmax(b)", {"a -= jnp.argmax(b)", "(jnp.argmin)"}),
        ("a = b or not c", {"(b and (not c))", "(c)"}),
        ("a = zip(b, c, strict=True)", set()),
        ("def f():\n    raise ValueError", {"pass"}),
        ("@d(frozen=True)\nclass A:\n    b = c.b(True)", {"(False)"}),
    ],
)
def test_what_is_changed(source, expected):
    assert {mutant.text for mutant in mutation.mutants(MODULE, source)} == expected


def test_a_mutant_replaces_its_bytes_alone():
    source = "# \u03bc\nx = 'µ' + y\n"
    (mutant,) = mutation.mutants(MODULE, source)
    data = source.encode()
    changed = data[: mutant.start] + mutant.text.encode() + data[mutant.end :]
    assert (mutant.line, changed.decode()) == (2, "# \u03bc\nx = ('µ' - y)\n")


@pytest.fixture
def checkout(tmp_path):
    """A package of one module, with four files of tests."""
    files = {
        "jaxsense/part/module.py": "def f(a, b):\n    return a + b\n\n\ndef g():\n    f(1, 2)\n",
        "tests/part/test_module.py": "",
        "tests/part/test_another.py": "",
        "tests/test_far.py": "from jaxsense.part import module",
        "tests/test_other.py": "import jaxsense.parts",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_the_nearest_tests_come_first(checkout):
    expected = ["tests/part/test_module.py", "tests/part/test_another.py", "tests/test_far.py"]
    assert mutation.tests_of(checkout, MODULE) == expected


def test_each_line_is_drawn_once(checkout):
    assert mutation.modules_of(checkout, []) == [MODULE]
    assert [m.line for m in mutation.draw(checkout, [MODULE], 9, 0)] in ([2, 6], [6, 2])
    assert len(mutation.draw(checkout, [MODULE], 1, 0)) == 1


@pytest.mark.parametrize(("b", "is_dead"), [(1, True), (0, False)])
def test_a_failing_test_kills(checkout, monkeypatch, b, is_dead):
    (checkout / "jaxsense/__init__.py").touch()
    monkeypatch.setattr(mutation, "tests_of", lambda root, module: ["tests.py"])
    mutant = next(mutation.mutants(MODULE, (checkout / MODULE).read_text()))
    assert mutant.text == "(a - b)"
    test = f"from jaxsense.part.module import f\n\n\ndef test():\n    assert f(1, {b}) == {1 + b}"
    (checkout / "tests.py").write_text(test)
    assert mutation.is_killed(checkout, mutant, 60.0) == is_dead
    assert "a + b" in (checkout / MODULE).read_text()


def test_without_a_failing_test_in_time_a_mutant_survives(checkout, monkeypatch):
    monkeypatch.setattr(mutation, "tests_of", lambda root, module: ["tests.py"])
    mutant = next(mutation.mutants(MODULE, (checkout / MODULE).read_text()))
    (checkout / "tests.py").write_text("import time\n\n\ndef test():\n    time.sleep(60)")
    assert not mutation.is_killed(checkout, mutant, 0.5)
