"""The documentation as a site: every page is in it, and the reference has every public name."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import griffe
import pytest
from docsite import ROOT, SiteError, building, checking, reference, staging

import fiber
from contract.site_search import search
from fiber.config import Config
from fiber_api.schema import schema


@pytest.fixture(scope="module")
def package() -> griffe.Module:
    return reference.load()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site; a warning of the generator or a broken link is an error."""
    return building.build(tmp_path_factory.mktemp("site"))


def page(site: Path, name: str) -> checking.Page:
    return checking.Page((site / name).read_text(encoding="utf-8"))


# ---- the written pages ----------------------------------------------------------------------


@pytest.mark.slow
def test_each_page_of_the_folder_is_in_the_site(site: Path) -> None:
    pages = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")]
    written = [site / str(name).replace("README.md", "index.md") for name in pages]
    assert [path for path in written if not path.with_suffix(".html").is_file()] == []


@pytest.mark.slow
def test_each_public_name_has_its_place_in_the_reference(
    site: Path, package: griffe.Module
) -> None:
    missing = []
    for module in [*reference.MODULES, "errors"]:
        own = [one.path for one in reference.definitions(package, module) if one.module == module]
        name = "errors" if module == "errors" else f"fiber.{module}"
        anchors = page(site, f"reference/{name}.html").anchors
        missing += [path for path in own if path not in anchors and path != MADE_AT_ITS_FIRST_USE]
    assert missing == []


MADE_AT_ITS_FIRST_USE = "fiber.errors.MaybeEncodingError"
"""multiprocessing.pool's class, which the tree of errors names."""


@pytest.mark.slow
def test_each_name_of_the_package_is_listed_with_a_link(site: Path) -> None:
    text = (site / "reference/fiber.html").read_text(encoding="utf-8")
    unlinked = {
        name for name in fiber.__all__ if not re.search(rf"<a [^>]*><code>{name}</code></a>", text)
    }
    pythons = {"AuthenticationError", "BufferTooShort", "ProcessError", "TimeoutError"}
    assert {name for name in unlinked if f"<code>{name}</code>" not in text} == set()
    # Functions on processes are multiprocessing's, and so are the logger's levels.
    others = {"SUBDEBUG", "SUBWARNING", "active_children", "current_process", "parent_process"}
    assert unlinked <= pythons | others


@pytest.mark.slow
def test_signatures_have_types(site: Path) -> None:
    text = (site / "reference/fiber.pool.html").read_text(encoding="utf-8")
    signature = re.sub(r"<[^>]+>", "", text.partition("fiber.pool.Pool.apply_async")[2])
    assert re.search(r"timeout:\s*float\s*\|\s*None\s*=\s*None", signature)


# ---- the search -----------------------------------------------------------------------------


@pytest.mark.slow
def test_the_search_index_is_a_file_of_the_site(site: Path) -> None:
    assert "fiber.pool" in (site / "search.js").read_text(encoding="utf-8")


QUESTIONS = {
    ("How do I install it?", "macos"): ("how-do-i-install-it",),
    ("Is it faster than Ray?",): ("is-it-faster-than-multiprocessing-ray-or-dask",),
    ("Why do I get no workers?",): ("why-do-i-get-no-workers", "doctor"),
    ("What if memory runs out?", "out of memory", "killed"): ("what-if-memory-runs-out",),
    ("How do I set a timeout?",): ("how-do-i-set-a-timeout",),
    ("How many workers?", "number of workers", "pool size"): ("how-many-workers", "sizing"),
    ("Why is it slow?", "slow", "speed up"): ("why-is-it-slow",),
    ("Where is my print?", "print", "output of workers", "stdout"): ("where-is-my-print",),
    ("What died?", "worker died"): ("what-died",),
    ("crash",): ("what-died", "checkpoints"),
    ("How do I use my own image?", "my image", "docker image"): (
        "how-do-i-use-my-own-image",
        "images-of-your-own",
    ),
    ("How do I stop it?", "stop", "cancel"): ("how-do-i-stop-it-or-cancel-a-task",),
    ("How do I pass data?", "share data", "large arguments"): ("how-do-i-pass-data-or-share-data",),
    ("Does it work in a notebook?", "jupyter"): ("does-it-work-in-a-notebook",),
    ("What does it cost on a laptop?", "laptop", "overhead"): ("what-does-it-cost-on-a-laptop",),
    ("How do I run on GPUs?", "gpu", "cuda"): ("how-do-i-run-on-gpus", "gpus"),
}
"""Questions of newcomers in several words; the answers: places of questions.md, or pages."""


@pytest.mark.slow
def test_a_newcomer_finds_an_answer_among_the_first_three_results(site: Path) -> None:
    asked = [(query, answers) for words, answers in QUESTIONS.items() for query in words]
    found = search(site, [query for query, _ in asked])
    missed = [
        f"{query!r}: {[result.location for result in results]}"
        for (query, answers), results in zip(asked, found, strict=True)
        if not any(answers_it(result.location, answers) for result in results[:3])
    ]
    assert not missed, "\n".join(missed)


ERRORS = {
    "too many open files": "TooManyOpenFiles",
    "cannot be pickled": "UnpicklableError",
    "died while it ran": "WorkerDied",
    "version mismatch": "VersionMismatch",
}
"""Words of messages, and the errors that have them."""


@pytest.mark.slow
def test_the_words_of_a_message_lead_to_the_error(site: Path) -> None:
    found = search(site, list(ERRORS))
    for (words, name), results in zip(ERRORS.items(), found, strict=True):
        page = f"reference/errors.html#fiber.errors.{name}"
        assert page in [result.location for result in results[:5]], words


def answers_it(location: str, answers: tuple[str, ...]) -> bool:
    name, _, place = location.partition("#")
    return (place if name == "questions.html" else name.removesuffix(".html")) in answers


@pytest.mark.slow
def test_the_search_leaves_out_tables_of_numbers(site: Path) -> None:
    results = [result for found in search(site, ["fiber", "multiprocessing"]) for result in found]
    assert results
    index = (site / "search.json").read_text(encoding="utf-8")
    assert '"benchmarks/overhead.html' not in index


@pytest.mark.slow
def test_a_page_has_a_light_and_a_dark_theme(site: Path) -> None:
    text = (site / "index.html").read_text(encoding="utf-8")
    assert 'data-md-color-scheme="default"' in text
    assert 'data-md-color-scheme="slate"' in text


# ---- the sources of the reference -----------------------------------------------------------


def test_each_key_of_the_configuration_is_described() -> None:
    text = reference.configuration_page()
    for field in dataclasses.fields(Config):
        assert f"## {field.name}\n" in text
        assert f"FIBER_{field.name.upper()}" in text


def test_each_field_of_a_fiber_pool_is_described() -> None:
    text = reference.fiberpool_page()
    for part in ("spec", "status"):
        for name in schema()["properties"][part]["properties"]:
            assert re.search(rf"^\| `{part}\.{name}` \| .+ \| .+ \|$", text, re.MULTILINE), name


def test_each_command_is_shown() -> None:
    text = reference.commands_page()
    for command in ("run", "ps", "logs", "stop", "stack", "doctor", "pool warm", "image build"):
        assert f"## fiber {command}\n" in text
        assert f"Usage: fiber {command}" in text


def test_each_error_is_described(package: griffe.Module) -> None:
    text = reference.errors_page(package)
    for name in fiber.errors.__all__:
        assert re.search(rf"\b{name}\b", text), name


def test_each_error_says_when_it_comes_and_what_to_do(package: griffe.Module) -> None:
    text = reference.errors_page(package)
    for name in fiber.errors.__all__:
        own = package["errors"].members.get(name)
        if isinstance(own, griffe.Class) and own.docstring:
            meaning = own.docstring.value
        else:
            meaning = text.partition(f"### {name}\n")[2].partition("\n#")[0]
        assert "When: " in meaning, name
        assert "What to do: " in meaning or name == "ProcessError", name


# ---- links ----------------------------------------------------------------------------------


def test_a_link_out_of_the_folder_leads_to_the_code_host(tmp_path: Path) -> None:
    found = staged(tmp_path, "[a](../sdk/a.py#L3) [b](other.md#place) ![c](images/c.png)")
    assert found == "[a](https://host/sdk/a.py#L3) [b](other.md#place) ![c](images/c.png)"


def test_a_link_to_a_source_leads_to_its_page_of_the_reference(tmp_path: Path) -> None:
    folder = tmp_path / "sdk" / "fiber"
    folder.mkdir(parents=True)
    (folder / "errors.py").touch()
    text = staged(tmp_path, "[errors](../sdk/fiber/errors.py)")
    assert text == "[errors](reference/errors.md)"


def test_code_is_not_changed(tmp_path: Path) -> None:
    text = "```py\nx = a[0](../sdk/a.py)\n```\n"
    assert staged(tmp_path, text) == text


def test_a_link_to_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SiteError, match=r"docs/page\.md: \.\./sdk/b\.py does not exist"):
        staged(tmp_path, "[b](../sdk/b.py)")


def staged(root: Path, text: str) -> str:
    for folder in ("docs", "sdk"):
        (root / folder).mkdir(exist_ok=True)
    (root / "sdk" / "a.py").touch()
    (root / "docs" / "page.md").write_text(text, encoding="utf-8")
    return staging.with_absolute_links(root / "docs" / "page.md", "https://host", root)


@pytest.mark.parametrize(
    ("element", "mistake"),
    [
        ('<a href="b.html#x">', None),
        ('<a href="https://elsewhere/">', None),
        ('<link rel="canonical" href="https://elsewhere/">', None),
        ('<img src="data:image/png;base64,">', None),
        ('<a href="b.html#y">', "links to b.html#y, which has no such place"),
        ('<a href="c.html">', "links to c.html, which does not exist"),
        ('<a href="#y">', "links to #y, which has no such place"),
        ('<script src="https://cdn/x.js">', "loads https://cdn/x.js from another host"),
        ('<link rel="stylesheet" href="//cdn/x.css">', "loads //cdn/x.css from another host"),
        ('<img src="x.png">', "loads x.png, which does not exist"),
    ],
)
def test_mistakes_of_pages_are_found(tmp_path: Path, element: str, mistake: str | None) -> None:
    (tmp_path / "a.html").write_text(element, encoding="utf-8")
    (tmp_path / "b.html").write_text('<h1 id="x">', encoding="utf-8")
    assert list(checking.mistakes(tmp_path)) == ([f"a.html: {mistake}"] if mistake else [])


def test_a_style_from_another_host_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").touch()
    (tmp_path / "a.css").write_text("x { background: url(https://cdn/x.png) }", encoding="utf-8")
    assert list(checking.mistakes(tmp_path)) == ["a.css: loads a file from another host"]
