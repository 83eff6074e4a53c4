"""The linter of prose finds planted faults; `nox -s lint` checks the project."""

import prose
import pytest


def planted(file, content):
    return [fault.split(": ", 1) for fault in prose.faults(prose.texts_of(file, content))]


@pytest.mark.parametrize(
    ("kind", "text", "words"),
    [
        ("message", "nobody asked", "person words"),
        ("page", "what it is", "elliptic openings"),
        ("docstring", "the mean strain", "verbs; at least 200"),
        ("docstring", "return the mean strain", None),
    ],
)
def test_counts_beyond_their_limits_are_faults(kind, text, words):
    """Limits of the whole project; `main` reports them with the other faults."""
    found = list(prose.unusual(kind, prose.counts([text])))
    assert [words in line for line in found] == [True] * (words is not None)


def test_faults_are_found_in_docstrings_comments_and_messages():
    source = (
        '"""What a file\ntells its reader."""\n'
        "def f():\n"
        '    """Too short."""\n'
        "    x = 1  # nobody reads this\n"
        '    raise ValueError(f"{x} goes\\non" " and on")\n'
    )
    found = sorted(planted("a.py", source))
    assert [(place, text.split(":")[0]) for place, text in found] == [
        ("a.py:1", "opens with 'What'"),
        ("a.py:2", "'tells'"),
        ("a.py:4", "'Too short.'"),
        ("a.py:5", "'nobody'"),
        ("a.py:6", "'goes on'"),
    ]


def test_faults_are_found_in_pages_and_experiments():
    code = "# Title\n\nThe `whose` of\n$who$ [it](settles.md).\n\n```\nsaid so\n```\n"
    found = planted("a.md", code + "\nA body whose end\nsettles.\n")
    assert [place for place, _ in found] == ["a.md:10", "a.md:11"]
    assert [place for place, _ in planted("a.yaml", "steps: 1\nmemory: 0 # it settles")] == [
        "a.yaml:2"
    ]


def test_every_replaced_expression_is_found():
    expressions = prose.replacements()
    assert len(expressions) > 60
    for expression, term in expressions.items():
        ((_, fault),) = planted("a.md", f"It {expression} here.")
        assert fault == f"'{expression}': {term}"
