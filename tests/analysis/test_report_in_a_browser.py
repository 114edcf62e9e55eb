"""The page of a report in a real browser, headless Chromium: it renders, asks for nothing, and fits on any screen."""

import contextlib
import http.server
import re
import shutil
import subprocess
import threading

import pytest
from report_study import write

from analysis import report_exhibits
from analysis.analyze import find
from analysis.report import report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium on the PATH")

QUIET = (
    "--headless --no-sandbox --disable-gpu --disable-dev-shm-usage --no-first-run --disable-background-networking "
    "--disable-component-update --disable-default-apps --disable-sync --disable-extensions --allow-file-access-from-files "
    "--enable-logging=stderr --log-level=0 --virtual-time-budget=15000"
)
SECTIONS = ("warnings", "run", "settings", "results", "methods", "checklist")
# The copy under measurement tells its frame how wide it is, and which element is the widest.
MEASURE = """<script>addEventListener("load", () => {
  const page = document.scrollingElement;
  const wide = [...document.querySelectorAll("body *")].filter(one => !one.parentElement.closest(".scroll, pre"))
    .filter(one => one.getBoundingClientRect().right > innerWidth + 1)
    .map(one => one.tagName + "." + one.className + "#" + one.id);
  parent.postMessage([innerWidth, page.scrollWidth, page.scrollHeight, wide.slice(0, 3).join(" ")].join("|"), "*");
})</script></body>"""
FRAMES = """<body><iframe src="copy.html" width="{}" height="900" style="border:0"></iframe>
<iframe src="copy.html" width="{}" height="900" style="border:0"></iframe>
<script>addEventListener("message", one => {{
  const said = document.createElement("p"); said.className = "said"; said.textContent = one.data; document.body.append(said);
}})</script></body>"""


def browse(folder, address, *flags):
    """Return the DOM after everything was loaded, and what Chromium wrote about it."""
    command = [CHROMIUM, *QUIET.split(), f"--user-data-dir={folder / 'profile'}", *flags, "--dump-dom", address]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=180, cwd=folder)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout, ran.stderr


@pytest.fixture(scope="module", params=["few", pytest.param("all", marks=pytest.mark.slow)])
def page(request, tmp_path_factory):
    """The report of a small study with a figure and two tables, and of one with all figures of chapter 6, as files."""
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "few":
            patch.setattr(report_exhibits, "everything", lambda: find(["learning-curve"], ["performance", "tuned-settings"]))
            made = report(write(folder / "store").write_studies(), "demo")
        else:
            made = report(request.getfixturevalue("real_store"), "chapter-6")
    (folder / "report.html").write_bytes(made.html())
    return folder / "report.html"


#: What Chromium asks for of its own accord, sooner or later: not always within the time of a blank page.
OF_THE_BROWSER = {
    "accounts.google.com",
    "clients2.google.com",
    "clientservices.googleapis.com",
    "content-autofill.googleapis.com",
    "optimizationguide-pa.googleapis.com",
    "update.googleapis.com",
}


@contextlib.contextmanager
def asked():
    """Yield the flags that send every request to a proxy here, and the set of hosts that are asked for."""
    hosts = set()

    class Proxy(http.server.BaseHTTPRequestHandler):
        def answer(self):
            hosts.add(re.sub(r"^\w+://", "", self.path).split("/")[0])
            self.send_error(404)

        do_GET = do_POST = do_CONNECT = do_HEAD = answer  # noqa: N815  (names that the server looks for)

        def log_message(self, *words):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Proxy) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield [f"--proxy-server=http://127.0.0.1:{server.server_address[1]}", "--proxy-bypass-list=<-loopback>"], hosts
        server.shutdown()


def test_the_page_renders_all_sections_and_images_without_a_word_on_the_console(page, tmp_path):
    dom, log = browse(tmp_path, page.as_uri())
    for section in SECTIONS:
        assert f'<section id="{section}"' in dom
    assert "CONSOLE" not in log
    broken = page.read_text("utf-8").replace("</body>", "<script>1</script></body>")
    (tmp_path / "broken.html").write_text(broken)
    assert "CONSOLE" in browse(tmp_path, (tmp_path / "broken.html").as_uri())[1]  # the policy of the page refuses the script


def test_no_request_leaves_the_page(page, tmp_path):
    with asked() as (flags, of_the_browser):
        browse(tmp_path, "about:blank", *flags)
    with asked() as (flags, hosts):
        browse(tmp_path, page.as_uri(), *flags)
    assert {host.split(":")[0] for host in hosts - of_the_browser} <= OF_THE_BROWSER
    (tmp_path / "asking.html").write_text('<img src="http://example.invalid/x.png">')
    with asked() as (flags, hosts):
        browse(tmp_path, (tmp_path / "asking.html").as_uri(), *flags)
    assert "example.invalid" in hosts


@pytest.mark.parametrize("widths", [(1280, 420)])
def test_the_page_fits_on_a_wide_and_on_a_narrow_screen(page, widths, tmp_path):
    text = re.sub(r"<meta http-equiv[^>]*>", "", page.read_text("utf-8")).replace("</body>", MEASURE)
    (tmp_path / "copy.html").write_text(text, "utf-8")
    (tmp_path / "frames.html").write_text(FRAMES.format(*widths))
    dom, _ = browse(tmp_path, (tmp_path / "frames.html").as_uri(), "--window-size=1800,1000")
    said = sorted((line.split("|") for line in re.findall(r'class="said">([^<]*)<', dom)), key=lambda one: -int(one[0]))
    assert [int(one[0]) for one in said] == pytest.approx(widths, abs=16)  # a scroll bar takes some
    for inner, scroll, height, wide in said:
        assert int(scroll) <= int(inner), wide
        assert int(height) > 5_000
        assert wide == ""
