"""The report in headless Chromium.

Filtering, sorting, a cell's episodes, a phone's width, print.
"""

import html
import json
import re
import shutil
import subprocess

import pytest
from sweep_results import add_curves, write_sweep
from test_report import painted_stage
from test_report_sweep import find

from surgicai_vision import report
from surgicai_vision.envs import contact_sheet
from surgicai_vision.report import sections
from surgicai_vision.report.groups import group
from surgicai_vision.report.pairs import compare
from surgicai_vision.report.reader import collect

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no chromium here: apt-get install chromium"
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A sweep's folder with its report."""
    folder = add_curves(write_sweep(tmp_path_factory.mktemp("sweep") / "table"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contact_sheet, "state_renderer", painted_stage)
        report.write_report(folder)
    return folder


@pytest.fixture(scope="module")
def groups(written):
    return group(collect(written))


def browse(folder, page, *options):
    """Open a page in a headless browser; return its finished process."""
    command = [
        CHROMIUM,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        "--v=0",
    ]
    command += [f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=5000", *options]
    return subprocess.run([*command, page], capture_output=True, text=True, timeout=90, check=True)


SCRIPT = """
<script>
(async () => {
  const say = {}, find = s => document.querySelector(s),
    all = s => [...document.querySelectorAll(s)];
  const column = n => all("#success tbody tr:not([hidden])").map(row =>
    row.cells[n].textContent.trim());
  say.all = column(0).length;
  const task = find("select[data-filter=task]");
  task.value = "insert"; task.dispatchEvent(new Event("input"));
  say.filtered = [...new Set(column(0))]; say.count = column(0).length;
  say.line = find("#shown").textContent;
  say.measures = [...new Set(all("#measures tbody tr:not([hidden])").map(row => row.dataset.task))];
  const words = find("#search"); words.value = "lite back"; words.dispatchEvent(new Event("input"));
  say.searched = column(1).length;
  task.value = ""; words.value = "";
  task.dispatchEvent(new Event("input")); words.dispatchEvent(new Event("input"));
  const heads = all("#success th button"),
    click = name => heads.find(b => b.textContent.startsWith(name)).click();
  const values = n => all("#success tbody tr").map(row => row.cells[n]?.dataset.v ?? "");
  click("success"); say.down = values(3); click("success"); say.up = values(3);
  click("time"); say.steps = values(7);
  click("task"); say.tasks = column(0);
  const row = all("#success tbody tr").find(r => r.textContent.includes("1 training seed failed"));
  row.click();
  say.open = find("#episodes").open; say.title = find("#episodes-title").textContent;
  say.squares = all("#episodes .squares button").length;
  say.won = all("#episodes .squares button").filter(b => b.textContent === "✓").length;
  say.films = all("#episodes figure.rollout").length;
  say.frames = all("#episodes figure.rollout img").length;
  say.dialog = find("#episodes-body").textContent; say.hash = location.hash;
  find("#episodes .pin").click(); say.pinned = all("#pinned figure img").length;
  find("#close").click(); say.closed = !find("#episodes").open;
  find(".heat td[data-group]").dispatchEvent(new KeyboardEvent("keydown", { key: "Enter",
    bubbles: true }));
  say.keyboard = find("#episodes").open; find("#close").click();
  find("td.absent[data-group]").click(); say.absent = find("#episodes-body").textContent;
  find("#close").click();
  const more = find("[data-all]"); more.click();
  say.pairs = all("#pair-table tbody tr").filter(r => r.offsetHeight > 0).length;
  say.images = all("img").filter(i => !(i.complete && i.naturalWidth > 0)).length;
  document.body.replaceChildren(Object.assign(document.createElement("pre"), { id: "said" }));
  find("#said").textContent = JSON.stringify(say);
})();
</script>
"""


@pytest.fixture(scope="module")
def said(written, tmp_path_factory):
    """What a reader who clicks through the page in a browser finds."""
    folder = tmp_path_factory.mktemp("browser")
    driven = folder / "driven.html"
    driven.write_text((written / "report.html").read_text().replace("</body>", SCRIPT + "</body>"))
    done = browse(folder, driven.as_uri(), "--dump-dom")
    assert "CONSOLE" not in done.stderr, done.stderr
    return json.loads(html.unescape(done.stdout.split('<pre id="said">')[1].split("</pre>")[0]))


def test_a_browser_filters_and_sorts(said, groups):
    plain = [item for item in groups if item.condition.plain]
    assert said["all"] == len(plain)
    assert said["filtered"] == said["measures"] == ["insert"]
    assert said["count"] == sum(item.condition.task == "insert" for item in plain)
    assert said["line"] == f"{said['count']} of {len(groups)} rows"
    assert said["searched"] == 2  # back, and front + back
    down, up = ([float(v) for v in said[key] if v] for key in ("down", "up"))
    assert down == sorted(down, reverse=True)
    assert up == sorted(up)
    assert said["down"][-1] == said["up"][-1] == "", "cells without a result come last either way"
    steps = [float(value) for value in said["steps"] if value]
    assert steps == sorted(steps) and len(steps) > 1
    assert not any(said["steps"][len(steps) :]), "cells that a reason spans come last"
    assert said["tasks"] == sorted(said["tasks"])


def test_a_click_on_a_cell_shows_its_episodes(said, groups):
    item = find(groups, task="handoff", encoder="imagenet", views=("back",))
    assert said["open"]
    assert said["closed"]
    assert said["keyboard"]
    assert said["title"] == "handoff: imagenet on back"
    assert (said["squares"], said["won"]) == (item.episodes, item.successes)
    assert said["films"] >= 2
    assert said["frames"] == 8 * said["films"]
    assert said["pinned"] == 8
    assert "the disk is full" in said["dialog"]
    assert "surgicai-vision evaluate outputs/sweeps/table/runs/" in said["dialog"]
    assert re.fullmatch(r"#cell-\d+", said["hash"])
    assert "weights are not here" in said["absent"]
    assert said["images"] == 0


def test_a_browser_shows_all_pairs_when_asked(said, groups):
    assert said["pairs"] == len(compare(groups)) > sections.PAIRS_SHOWN


def test_at_a_phones_width_nothing_but_marked_tables_is_wider(written, tmp_path):
    frame = tmp_path / "phone.html"
    source = (written / "report.html").as_uri()
    frame.write_text(
        f'<iframe id="f" src="{source}"'
        ' style="width:375px;height:800px;border:0"></iframe><script>addEventListener("load", ()'
        ' => { const d = document.getElementById("f").contentDocument;const wide ='
        ' [...d.querySelectorAll("main *")].filter(n => n.getBoundingClientRect().right > 376 &&'
        ' !n.closest(".scroll, dialog")).map(n => n.tagName + "." +'
        ' n.className);document.body.dataset.said = d.documentElement.scrollWidth + ":" +'
        ' wide.join(","); });</script>'
    )
    done = browse(
        tmp_path,
        frame.as_uri(),
        "--dump-dom",
        "--hide-scrollbars",
        "--allow-file-access-from-files",
    )
    assert re.search(r'data-said="([^"]*)"', done.stdout)[1] == "375:"


def test_the_page_prints(written, tmp_path):
    out = tmp_path / "page.pdf"
    browse(
        tmp_path,
        (written / "report.html").as_uri(),
        f"--print-to-pdf={out}",
        "--no-pdf-header-footer",
    )
    pages = len(re.findall(rb"/Type\s*/Page\b", out.read_bytes()))
    assert 3 <= pages <= 20
