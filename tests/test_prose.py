"""The prose of the project is plain technical English, and the linter finds planted faults."""

import prose
import pytest


@pytest.fixture(scope="module")
def texts():
    return prose.project_texts()


def planted(file, content):
    return [fault.split(": ", 1) for fault in prose.faults(prose.texts_of(file, content))]


def test_project_has_no_prose_faults(texts):
    assert list(prose.faults(texts)) == []


@pytest.mark.parametrize(
    ("kind", "persons", "verbs"), [("docstring", 8, 200), ("message", 8, 0), ("page", 8, 0)]
)
def test_counts_match_those_of_well_kept_packages(texts, kind, persons, verbs):
    folder = "docs/" if kind == "page" else "pbdkit/"
    chosen = [t.text for t in texts if t.kind == kind and t.file.startswith(folder)]
    counts = prose.counts(chosen)
    assert counts["texts"] > 1000
    assert counts["person words per 10 000"] <= persons
    assert counts["plain verbs per 10 000"] >= verbs
    assert kind == "page" or counts["elliptic openings, %"] <= 3


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
