"""The lessons in a real JupyterLab, and the book, in headless Chromium. Pictures: ``build/screenshots``."""

import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import nbformat
import pytest

from dmsrd_lite.workbook import book, lab
from dmsrd_lite.workbook.lessons import NOTEBOOKS
from dmsrd_lite.workbook.records import ROOT

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update"]  # fmt: skip
PICTURES = ROOT / "build" / "screenshots"
TOO_WIDE = """selector => [...document.querySelectorAll(selector)]
    .filter(e => e.scrollWidth > e.clientWidth + 2).map(e => e.outerHTML.slice(0, 300))"""

pytestmark = [pytest.mark.verify, pytest.mark.skipif(not CHROMIUM, reason="no Chromium on this machine")]


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    PICTURES.mkdir(parents=True, exist_ok=True)
    with playwright.sync_playwright() as run:
        started = run.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield started
        started.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A JupyterLab on loopback, as ``make lab`` sets it up: the folder of its lessons, and its address."""
    folder = tmp_path_factory.mktemp("lab")
    lab.copy_lessons(folder / "mine")
    environment = lab.configure()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = ["--no-browser", "--allow-root", "--IdentityProvider.token=", f"--ServerApp.port={port}"]
    options += [
        "--ServerApp.ip=127.0.0.1",
        f"--ServerApp.root_dir={folder}",
        "--LabApp.expose_app_in_browser=True",
    ]
    log = (folder / "log").open("w")
    process = subprocess.Popen(
        [sys.executable, "-m", "jupyterlab", *options], stdout=log, stderr=log, cwd=folder, env=environment
    )
    address = f"http://127.0.0.1:{port}"
    for _ in range(120):
        try:
            urllib.request.urlopen(f"{address}/api").close()
            break
        except OSError:
            time.sleep(0.5)
    yield folder / "mine", address
    process.terminate()
    process.wait(20)


class Opened:
    """One notebook in JupyterLab."""

    def __init__(self, browser, server, name):
        self.folder, address = server
        self.path = self.folder / f"{name}.ipynb"
        self.page = browser.new_page(viewport={"width": 1280, "height": 900})
        self.page.set_default_timeout(120_000)
        self.page.goto(f"{address}/lab/workspaces/{self.path.stem}/tree/mine/{name}.ipynb?reset")
        self.page.wait_for_selector(".jp-Notebook .jp-Cell")
        self.page.wait_for_function("window.jupyterapp.shell.currentWidget?.sessionContext?.session?.kernel")

    def do(self, command, **arguments):
        call = "([c, a]) => window.jupyterapp.commands.execute(c, a).then(() => null)"
        self.page.evaluate(call, [command, arguments])

    def run_all(self):
        """Run every cell; the outputs, as they are saved, by cell."""
        self.do("notebook:run-all-cells")
        self.do("docmanager:save")
        return [c for c in nbformat.read(self.path, 4).cells if c.cell_type == "code"]

    def picture(self, name):
        self.page.screenshot(path=PICTURES / f"{name}.png")


def errors(cells):
    return [o.evalue for c in cells for o in c.outputs if o.output_type == "error"]


@pytest.mark.parametrize(
    "name", ["00_start_here", "02_airl", "04_policy_mixture", "exercises/04_policy_mixture/04_policy_mixture"]
)
def test_a_notebook_runs_and_fits_the_page(name, browser, server):
    opened = Opened(browser, server, name)
    cells = opened.run_all()
    if name.startswith("exercises"):  # stops at the first task, which nobody has done
        (sentence,) = errors(cells)
        assert "not yet" in sentence
    else:
        assert all(c.execution_count for c in cells if c.source.strip())
        assert not errors(cells)
    shown = opened.page.locator(".jp-Notebook .jp-Cell")
    for i in range(shown.count()):  # a cell is drawn when it comes into sight
        shown.nth(i).scroll_into_view_if_needed()
    assert not opened.page.evaluate(TOO_WIDE, ".jp-RenderedHTMLCommon, .jp-RenderedImage, .jp-Notebook")
    figures = opened.page.locator(".jp-Notebook .jp-RenderedImage")
    if figures.count():
        figures.first.scroll_into_view_if_needed()
    for theme in ("JupyterLab Dark", "JupyterLab Light"):
        opened.do("apputils:change-theme", theme=theme)
        opened.page.wait_for_timeout(1500)
        opened.picture(f"{name.replace('/', '_')}_{theme.split()[1].lower()}")
    opened.page.close()


def test_a_slider_changes_its_picture_which_stays_without_a_kernel(browser, server):
    opened = Opened(browser, server, "04_policy_mixture")
    page = opened.page
    opened.run_all()
    handle = page.locator(".jp-Notebook .noUi-handle").first
    handle.scroll_into_view_if_needed()
    cell = page.locator(".jp-Cell", has=page.locator(".noUi-handle")).first
    source = cell.locator("img").first.get_attribute("src")
    handle.focus()
    handle.press("ArrowLeft")
    page.wait_for_function(
        "([cell, before]) => cell.querySelector('img').src !== before", arg=[cell.element_handle(), source]
    )
    opened.picture("slider")
    opened.do("docmanager:save")
    opened.do("kernelmenu:shutdown")
    page.close()
    again = Opened(browser, server, "04_policy_mixture")
    shown = again.page.locator(".jp-CodeCell", has_text="slider(").first
    shown.scroll_into_view_if_needed()
    assert shown.locator("img").first.bounding_box()["height"] > 100
    again.picture("reopened")
    again.page.close()


def test_somebody_steers_by_the_keyboard_and_is_recorded(browser, server):
    opened = Opened(browser, server, "09_beyond")
    page, cells = opened.page, nbformat.read(NOTEBOOKS / "09_beyond.ipynb", 4).cells
    (steering,) = (i for i, cell in enumerate(cells) if cell.source.endswith("cockpit(steering)"))
    activate = "k => { window.jupyterapp.shell.currentWidget.content.activeCellIndex = k }"
    page.evaluate(activate, steering + 1)
    opened.do("notebook:run-all-above")
    handle = page.locator(".jp-Notebook .noUi-handle").first
    handle.scroll_into_view_if_needed()
    picture = page.locator(".jp-Notebook .widget-image").first
    first = picture.get_attribute("src")
    handle.focus()
    for _ in range(4):
        handle.press("ArrowRight")
    clock = page.locator(".jp-Notebook .widget-play button").first
    clock.click()
    page.wait_for_function("([image, first]) => image.src !== first", arg=[picture.element_handle(), first])
    page.wait_for_timeout(3000)
    opened.picture("steering")
    clock.click()
    page.evaluate(activate, steering + 2)
    opened.do("notebook:run-cell")
    opened.do("docmanager:save")
    asked = nbformat.read(opened.path, 4).cells[steering + 2]
    assert asked.execution_count
    assert not asked.outputs  # else: nobody steers
    (play,) = (i for i, cell in enumerate(cells) if "lessons.slider(play" in cell.source)
    for k in range(play - 3, play + 1):
        page.evaluate(activate, k)
        opened.do("notebook:run-cell")
    shares = page.locator(".jp-CodeCell", has_text="lessons.slider(play").first
    shares.locator("select").scroll_into_view_if_needed()
    opened.picture("play")
    widths = "all => all.map(one => one.getBoundingClientRect().width)"
    tracks = shares.locator(".noUi-target").evaluate_all(widths)
    assert len(tracks) == 5
    assert min(tracks) > 100, "a track that a mouse can move along"
    cell, choice = shares.bounding_box(), shares.locator("select").bounding_box()
    assert choice["x"] + choice["width"] <= cell["x"] + cell["width"]
    page.close()


def test_a_link_leads_to_the_next_lesson_and_a_wrong_parameter_to_one_sentence(browser, server):
    opened = Opened(browser, server, "00_start_here")
    page = opened.page
    link = page.locator(".jp-Notebook a", has_text="01_demonstrations").last
    link.scroll_into_view_if_needed()
    link.click()
    page.wait_for_function("window.jupyterapp.shell.currentWidget?.title.label === '01_demonstrations.ipynb'")
    page.close()
    opened = Opened(browser, server, "00_start_here")
    opened.page.evaluate("""() => {
        for (const { sharedModel } of window.jupyterapp.shell.currentWidget.content.model.cells) {
            const typed = sharedModel.getSource().replace(/^domain: str = "\\w+"/, 'domain = "pendulm"');
            sharedModel.setSource(typed);
        }
    }""")
    sentence, *later = errors(opened.run_all())
    assert "pendulm" in sentence
    assert all("is not defined" in one for one in later), "a cell may run before JupyterLab cancels it"
    assert len(sentence.splitlines()) == 1
    said = opened.page.locator(".jp-Notebook .jp-OutputArea", has_text=sentence).first
    opened.page.wait_for_timeout(1500)  # the notebook scrolls by itself
    said.scroll_into_view_if_needed()
    opened.page.wait_for_timeout(500)
    assert said.is_visible()
    opened.picture("wrong_parameter")
    opened.page.close()


def test_the_book_opens_without_a_network(browser, server, tmp_path):
    executed, name = Path(shutil.copytree(NOTEBOOKS, tmp_path / "executed")), "01_demonstrations"
    opened = Opened(browser, server, name)
    opened.run_all()
    opened.page.close()
    shutil.copyfile(opened.path, executed / opened.path.name)
    first = book.make_book(executed, tmp_path / "book")
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((first.parent / f"{name}.html").as_uri())
    film = page.locator("main video").first
    film.scroll_into_view_if_needed()
    assert film.evaluate("film => film.play().then(() => film.videoWidth)") > 100
    page.screenshot(path=PICTURES / "film.png")
    assert all(page.locator("main img").evaluate_all("all => all.map(one => one.alt.length > 20)"))
    assert page.locator("main img").count()
    page.goto((first.parent / "exercise_02_airl.html").as_uri())
    assert not page.locator("details pre").first.is_visible()
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(first.as_uri())
    page.locator("nav a", has_text="02 Adversarial").click()
    assert page.locator("math").count() > 20
    answer = page.locator("details").first
    lesson = nbformat.read(NOTEBOOKS / "02_airl.ipynb", 4)
    told = "\n".join(cell.source for cell in lesson.cells).split("<summary>Answer</summary>")[1]
    told = " ".join(told.split()[:4])  # the first words of the lesson's first answer
    assert told not in answer.inner_text()
    answer.locator("summary").click()
    assert told in answer.inner_text()
    assert page.evaluate("document.documentElement.scrollWidth") <= 1280
    page.screenshot(path=PICTURES / "book.png")
    assert all(url.startswith(("file:", "data:")) for url in asked)
    page.close()
