"""`sweep report`: the page and the command, for whole studies and for others."""

import base64
import gzip
import hashlib
import html.parser
import json
import math
import re

import pytest
from report_study import write
from synthetic_store import SyntheticStore

from analysis import report_exhibits
from analysis.analyze import analyze, everything, find
from analysis.report import report
from analysis.report_page import csv_link, marked
from sweep.failures import Failure
from sweep.messages import UserError
from sweep.store import Store


class Page(html.parser.HTMLParser):
    """Collects headings, ids, links and tags, and sees that every tag is closed in its turn."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.links, self.images, self.headings, self.tags = [], [], [], [], [], set()
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag, attrs):
        known = dict(attrs)
        self.tags.add(tag)
        self.ids += [known["id"]] if "id" in known else []
        self.links += [known["href"]] if "href" in known else []
        self.images += [known] if tag == "img" else []
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("h1", "h2", "h3"):
            self.headings.append((self.open[-1], data.strip()))


def page_of(made):
    return Page(made.html().decode())


@pytest.fixture
def few_exhibits(monkeypatch):
    """Reports with one figure and two tables, for tests that are about the page."""
    monkeypatch.setattr(report_exhibits, "everything", lambda: find(["learning-curve"], ["performance", "tuned-settings"]))


def test_numbered_figures_are_shown_of_their_own_study_and_its_small_version():
    def named(study):
        return [entry.name for entry, _ in report_exhibits._wanted(study, ["per-environment"])]

    assert {"6.1", "6.6", "A.1", "A.4"} <= set(named("chapter-6")) == set(named("small-chapter-6"))
    assert "7.1" in named("figure-7-1")
    assert "7.2" in named("small-figure-7-2")
    assert not [name for name in named("mine") if re.search(r"\d\.\d|A\.", name)]
    assert {"learning-curve", "performance", "selection"} <= set(named("mine"))


def test_what_shows_one_rule_is_shown_once_for_each_rule_of_the_study():
    wanted = list(report_exhibits._wanted("mine", ["across-environments", "per-environment"]))
    assert [rule for entry, rule in wanted if entry.name == "learning-curve"] == ["per-environment", "across-environments"]
    assert [rule for entry, rule in wanted if entry.name == "comparison"] == [""]


def test_the_checksum_is_that_of_the_csv_that_analyze_writes(tmp_path, few_exhibits):
    path = write(tmp_path / "store", environments=["Pendulum-CA"]).write_studies()
    made = report(path, "demo", pictures=False)
    analyze(path, find(["learning-curve"], ["performance"]), "demo", tmp_path, ["csv"])
    sums = {one.label: one.sha256 for one in made.exhibits if one.rule in ("", "per-environment")}
    assert sums["figure learning-curve"] == hashlib.sha256((tmp_path / "figure-learning-curve.csv").read_bytes()).hexdigest()
    assert sums["table performance"] == hashlib.sha256((tmp_path / "table-performance.csv").read_bytes()).hexdigest()


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("figure 6.1", "Figure 6.1"),
        ("table A.1", "Table A.1"),
        ("figure learning-curve", "Learning curve"),
        ("table tuned-settings (per-environment)", "Tuned settings (per-environment)"),
        ("figure importance", "Importance of hyperparameters"),
        ("table importance", "Shares of variance"),
    ],
)
def test_readers_get_numbers_or_names_for_kinds(label, name):
    assert report_exhibits.display_name(label) == name


def test_no_two_figures_and_tables_have_the_same_name():
    names = [
        report_exhibits.display_name(("figure " if hasattr(one, "demonstration") else "table ") + one.name)
        for one in everything()
    ]
    assert len(names) == len(set(names))


def test_a_study_of_one_rule_shows_no_choices_of_the_other():
    def asked(rule):
        return {entry.name: by for entry, by in report_exhibits._wanted("mine", [rule])}

    across, own = asked("across-environments"), asked("per-environment")
    for name in ("learning-curve", "tuned-settings", "performance", "selection"):
        assert (across[name], own[name]) == ("across-environments", "per-environment")
    assert (across["evaluation-curve"], own["evaluation-curve"]) == ("across-environments", "")


def test_large_csv_is_compressed_and_very_large_left_out():
    small, large = b"a,b\n1,2\n", b"a,b\n" + b"1,2\n" * 20_000
    link, suffix = csv_link(small)
    assert (base64.b64decode(link.partition(",")[2]), suffix) == (small, "csv")
    link, suffix = csv_link(large)
    assert (gzip.decompress(base64.b64decode(link.partition(",")[2])), suffix) == (large, "csv.gz")
    assert csv_link(bytes(range(256)) * 20_000 + hashlib.sha256(b"").digest())[0]
    noise = b"".join(hashlib.sha256(bytes([i % 256, i // 256])).digest() for i in range(40_000))
    assert csv_link(noise)[0] == ""


@pytest.fixture(scope="module")
def real_reports(real_store):
    return {study: report(real_store, study, pictures=False) for study in ("chapter-3", "chapter-6")}


SECTIONS = ["Contents", "Warnings", "What was run", "Chosen settings", "Figures and tables", "Methods", "Checklist"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A study whose page has everything."""
    path = write(tmp_path_factory.mktemp("whole") / "store").write_studies()
    (path / "studies" / "demo" / "grid.toml").write_text('[study]\nname = "demo"\n')
    return path


def test_the_page_has_all_sections_and_every_link_within_it_leads_somewhere(whole, few_exhibits):
    page = page_of(report(whole, "demo"))
    assert [text for tag, text in page.headings if tag == "h1"] == ["demo"]
    assert [text for tag, text in page.headings if tag == "h2"] == SECTIONS
    assert len(page.ids) == len(set(page.ids))
    for link in page.links:
        assert link.startswith(("#", "data:text/csv", "data:application/gzip")), link
        assert not link.startswith("#") or link[1:] in page.ids, link


def test_every_figure_has_its_caption_an_alternative_text_and_its_numbers(whole, few_exhibits):
    made = report(whole, "demo")
    page = page_of(made)
    figures = [one for one in made.exhibits if one.label.startswith("figure")]
    assert figures
    assert len(page.images) == len(figures)
    for one, image in zip(figures, page.images, strict=True):
        assert image["src"].startswith(("data:image/svg+xml;base64,", "data:image/png;base64,"))
        assert len(image["alt"]) > 60
        assert one.title in image["alt"]
        assert float(image["width"]) > float(image["height"]) / 3 > 0
    text = made.html().decode()
    assert "Tuned settings: Chosen settings" in text
    assert "Learning curve: " in text
    assert not re.search("(Figure|Table) [a-z]", text)
    for one in made.exhibits:
        assert one.sha256 in text
        assert str(marked(one.caption)) in text


def test_the_page_asks_for_nothing_and_runs_nothing(whole, few_exhibits):
    text = report(whole, "demo").html().decode()
    assert "default-src 'none'" in text
    assert "script" not in Page(text).tags
    addresses = re.findall(r"(?:src|href|action|data|url\()=?[\"']?(\w+:)", re.sub(r"base64,[\w+/=]+", "", text))
    assert set(addresses) <= {"data:"}


def test_hostile_names_hosts_and_errors_are_shown_as_text(tmp_path, few_exhibits):
    hostile = "<script>alert('x')</script>\u202e\x00\x1b[31m & \"quoted\" {{ 7 * 7 }}"
    store = write(tmp_path, host=hostile, engine=hostile, commit=hostile, versions=json.dumps({hostile: hostile}))
    path = store.write_studies()
    (path / "studies" / "demo" / "grid.toml").write_text(f"# {hostile}".replace("\x00", "").replace("\x1b", ""))
    trial = {"trial": store.plan("demo", "SAC", "Pendulum-CA", 92)["trial"], "agent": hostile, "environment": hostile, "seed": 92}
    store.write_studies()
    Store.open(path)._failures.write("s", Failure((trial,), hostile, hostile, hostile, 1, hostile))
    text = report(path, "demo").html().decode()
    assert "script" not in Page(text).tags
    assert "&lt;script&gt;" in text
    assert "{{ 7 * 7 }}" in text
    assert not re.search("[\u202e\x00\x1b]", text)


@pytest.mark.slow
def test_the_name_of_a_numbered_table_keeps_its_capital(real_reports):
    headings = [text for tag, text in page_of(real_reports["chapter-6"]).headings if tag == "h3"]
    assert "Table A.1: Settings tuned across environments" in headings


def test_code_in_captions_is_marked_and_escaped():
    assert str(marked("see `a < b` & <i>")) == "see <code>a &lt; b</code> &amp; &lt;i&gt;"
    assert str(marked("`<b>`")) == "<code>&lt;b&gt;</code>"


@pytest.mark.slow
def test_the_whole_catalogue_is_on_the_page_of_a_study_of_ones_own(whole):
    made = report(whole, "demo")
    there = {one.label for one in made.exhibits} | {one.label.split(" (")[0] for one in made.left_out}
    assert {"figure slice", "figure seed-spread", "table comparison"} <= there
    assert [text for tag, text in page_of(made).headings if tag == "h2"] == SECTIONS


def test_the_same_store_gives_the_same_bytes(whole, few_exhibits):
    assert report(whole, "demo").html() == report(whole, "demo").html()


def test_the_same_is_said_in_json(whole, few_exhibits):
    made = report(whole, "demo", seed=3, pictures=False)
    content = json.loads(json.dumps(made.content(), allow_nan=False))
    assert (content["study"], content["seed"], content["methods"]) == ("demo", 3, made.methods)
    assert [one["kind"] for one in content["warnings"]] == [one.kind for one in made.warnings]
    assert content["run"]["seeds"] == {"tune": [0, 1], "evaluate": [2, 3, 4]}
    assert content["run"]["totals"]["core_hours"] == 18
    shown = {(one["label"], one["rule"]): one for one in content["exhibits"]}
    assert shown["figure learning-curve", "per-environment"]["num_rows"] > 0
    assert all(one["sha256"] and one["caption"] for one in content["exhibits"])
    assert len(content["checklist"]) == len(made.checklist)


def diverged(store):
    for seed in range(3):
        store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed), [math.nan])


def one_seed(store):
    for x in (1e-3, 1e-2):
        store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0, critic_step_size=x), [1.0, 2.0])


def nothing_yet(store):
    store.plan("demo", "SAC", "Pendulum-CA", 0)


def nothing_completed(store):
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0), [5.0], ["budget"])


def best_return_is_zero(store):
    for environment in ("Pendulum-CA", "MountainCar-CA"):
        for x in (1e-3, 1e-2):
            for seed in range(2):
                store.finish(store.plan("demo", "SAC", environment, seed, critic_step_size=x), [-1.0 - seed, 0.0])


@pytest.mark.parametrize(
    ("fill", "kind", "text"),
    [
        (diverged, "diverged", "All runs diverged: scores say nothing."),
        (one_seed, "few-seeds", "there are no intervals at all"),
        (nothing_yet, "no-runs", "None of 1 trial is in the store"),
        (nothing_completed, "no-score", "completed no episode and have no score"),
        (best_return_is_zero, "normalizer", "has no value on MountainCar-CA, Pendulum-CA: G* is 0 there"),
    ],
)
def test_a_study_that_is_not_whole_has_a_page_that_says_so(fill, kind, text, tmp_path, few_exhibits):
    store = SyntheticStore(tmp_path)
    fill(store)
    made = report(store.write_studies(), "demo", pictures=False)
    assert any(text in warning.text for warning in made.warnings if warning.kind == kind), made.warnings
    page = page_of(made)
    assert [text for tag, text in page.headings if tag == "h2"] == SECTIONS
    assert all(one.reason for one in made.left_out)
    json.dumps(made.content(), allow_nan=False)


def test_an_unknown_study_is_answered_with_the_known_ones(whole):
    with pytest.raises(UserError, match='unknown study "demi": did you mean "demo"'):
        report(whole, "demi")


@pytest.mark.slow
def test_studies_of_the_real_store_have_their_own_figures_in_their_reports(real_reports):
    labels = {study: {one.label for one in made.exhibits} for study, made in real_reports.items()}
    for study, own in {
        "chapter-3": {"figure 3.1", "figure 3.2", "figure 3.3"},
        "chapter-6": {"figure 6.1", "figure 6.2", "figure 6.4", "figure 6.5", "table 6.1", "table A.1", "table A.2", "table A.3"},
    }.items():
        left_out = {one.label: one.reason for one in real_reports[study].left_out}
        assert own <= labels[study], (own - labels[study], left_out)


@pytest.mark.slow
def test_every_exhibit_is_shown_or_left_out_with_a_reason(real_reports):
    for study, made in real_reports.items():
        wanted = {
            ("figure " if hasattr(entry, "demonstration") else "table ") + entry.name
            for entry, _ in report_exhibits._wanted(study, [])
        }
        there = {one.label for one in made.exhibits} | {one.label.split(" (")[0] for one in made.left_out}
        assert there == wanted
        assert len({one.anchor for one in made.exhibits}) == len(made.exhibits)
