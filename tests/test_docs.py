"""The documentation stays short where a user reads it, dated where it is a notebook, and whole."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
PACKAGE = ROOT / "lang3dxl_ns"
USER_PAGES = sorted(path for path in DOCS.glob("*.md") if path.name != "changelog.md")
LAB_PAGES = sorted((DOCS / "lab").rglob("*.md"))
PAGES = [README, ROOT / "lab" / "README.md", DOCS / "changelog.md", *USER_PAGES, *LAB_PAGES]

DATE = re.compile(r"\b20\d\d-\d\d-\d\d\b")
COMMAND = re.compile(r"^(?: {4}|`)(?:\w+=\S+ )*(?:lang3dxl|ns-\w+|pytest|python) ", re.MULTILINE)
LINK = re.compile(r"(?<!`)\]\((?!https?:|mailto:)([^)\s#]*)(?:#([^)\s]*))?\)")
NAMED_IN_PAGE = re.compile(r"`((?:lang3dxl_ns/|lab/|tests/)?[a-z_]+/[a-z_/]*\.py)`")
NAMED_IN_CODE = re.compile(r"\bdocs/[\w/]+\.(?:md|png|ipynb)\b")
CODE = {".py", ".yaml", ".md", ".js", ".html"}
NOTEBOOK = re.compile(r"\b(?:was|were) tried\b|\bnot tried\b|\bis not kept\b|busy with other work")
"""Phrases of a notebook, which belong into docs/lab."""


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def words(text: str) -> int:
    """Words with a letter or digit, code and tables included, rules and bars of tables left out."""
    return sum(1 for word in text.split() if re.search(r"\w", word))


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def broken_links(page: Path) -> list[str]:
    """Relative links of a page that lead nowhere."""
    broken = []
    for target, anchor in LINK.findall(page.read_text()):
        found = (page.parent / target).resolve() if target else page
        if not found.exists() or (anchor and found.suffix == ".md" and anchor not in anchors(found)):
            broken.append(f"{target}#{anchor}" if anchor else target)
    return broken


def test_the_readme_has_at_most_800_words():
    assert words(README.read_text()) <= 800


@pytest.mark.parametrize("page", USER_PAGES, ids=name)
def test_a_user_page_has_at_most_900_words(page):
    assert words(page.read_text()) <= 900


def test_user_pages_together_have_at_most_13_000_words():
    assert sum(words(page.read_text()) for page in USER_PAGES) <= 13_000


@pytest.mark.parametrize("page", USER_PAGES, ids=name)
def test_a_user_page_is_not_a_notebook(page):
    assert not NOTEBOOK.findall(page.read_text())


@pytest.mark.parametrize("page", LAB_PAGES, ids=name)
def test_a_laboratory_page_begins_with_date_and_command(page):
    top = "\n".join(page.read_text().splitlines()[:15])
    assert DATE.search(top) and COMMAND.search(top)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_relative_links_resolve(page):
    assert broken_links(page) == []


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "changelog.md"], ids=name)
def test_the_code_that_a_page_names_is_there(page):
    named = NAMED_IN_PAGE.findall(page.read_text())
    assert [
        path for path in named if not any((at / path).is_file() for at in (ROOT, PACKAGE, page.parent))
    ] == []


def test_a_link_to_no_page_or_heading_is_found(tmp_path):
    (tmp_path / "there.md").write_text("# Here it is: `a` & b\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[a](there.md#here-it-is-a--b) [b](there.md#elsewhere) [c](nowhere.md) [d](#none) [e](https://x.y)"
    )
    assert broken_links(page) == ["there.md#elsewhere", "nowhere.md", "#none"]


def test_pages_named_in_code_exist():
    folders = ("lang3dxl_ns", "configs", "lab", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in CODE]
    files.append(ROOT / "pyproject.toml")
    named = {page for path in files for page in NAMED_IN_CODE.findall(path.read_text())}
    assert len(named) > 5 and not [page for page in sorted(named) if not (ROOT / page).exists()]


def test_the_index_leads_to_every_user_page_and_once_to_the_laboratory():
    index = (DOCS / "index.md").read_text()
    listed = re.findall(r"^(?:.*<)?([\w/]+)>?$", index, re.MULTILINE)
    assert {page.stem for page in USER_PAGES} - {"index"} <= set(listed)
    assert index.count("lab/") == 1
    laboratory = DOCS / "lab" / "index.md"
    pages = [page for page in laboratory.parent.glob("*.md") if page != laboratory]
    assert all(f"]({page.name})" in laboratory.read_text() for page in pages)
