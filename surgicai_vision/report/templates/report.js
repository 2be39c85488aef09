"use strict";
(() => {
  const find = (selector, root = document) => root.querySelector(selector);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const data = JSON.parse(find("#details").textContent);
  const KINDS = JSON.parse(find("#kinds").textContent);
  const make = (tag, attributes = {}, ...children) => {
    const node = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    node.append(...children);
    return node;
  };

  // Filter: every table of conditions follows the same choices.
  const rows = all("tr[data-task]");
  const filter = () => {
    const words = (find("#search")?.value || "").toLowerCase().split(/\s+/).filter(Boolean);
    const chosen = all("select[data-filter]").map(select => [select.dataset.filter, select.value]);
    let shown = 0, total = 0;
    for (const row of rows) {
      const fits = chosen.every(([name, value]) => !value || row.dataset[name] === value);
      row.hidden = !(fits && words.every(word => row.textContent.toLowerCase().includes(word)));
      if (row.closest("#success")) { total += 1; shown += row.hidden ? 0 : 1; }
    }
    const line = find("#shown");
    if (line) line.textContent = shown === total ? `${total} rows` : `${shown} of ${total} rows`;
  };
  all("select[data-filter], #search").forEach(node => node.addEventListener("input", filter));

  // Sort: numbers by their value, the rest as text; what is absent comes last either way.
  const sort = (table, column, direction) => {
    const body = table.tBodies[0];
    const key = row => {
      const cell = row.cells[column]; // missing beside one that spans several columns
      return cell?.dataset.v ?? cell?.textContent.trim() ?? "";
    };
    const compare = (a, b) => {
      const [x, y] = [key(a), key(b)];
      const absent = (x === "" || x === "–") - (y === "" || y === "–");
      if (absent) return absent;
      const numbers = x !== "" && y !== "" && !isNaN(x) && !isNaN(y);
      return direction * (numbers ? x - y : x.localeCompare(y));
    };
    [...body.rows].sort(compare).forEach(row => body.append(row));
    body.querySelectorAll(".starts").forEach(row => row.classList.remove("starts"));
    all("th", table).forEach((head, index) => {
      if (index === column) head.setAttribute("aria-sort", direction > 0 ? "ascending" : "descending");
      else head.removeAttribute("aria-sort");
    });
  };
  for (const table of all("table.sortable")) {
    all("th", table).forEach((head, column) => find("button", head)?.addEventListener("click", () => {
      const first = head.dataset.first === "down" ? -1 : 1, now = head.getAttribute("aria-sort");
      const same = (first > 0 && now === "ascending") || (first < 0 && now === "descending");
      sort(table, column, same ? -first : first);
    }));
  }
  find("#sort")?.addEventListener("input", event => {
    const [column, direction] = event.target.value.split(",").map(Number);
    sort(find("#success"), column, direction);
  });
  all("button[data-all]").forEach(button => button.addEventListener("click", () => {
    const table = document.getElementById(button.dataset.all);
    button.textContent = table.classList.toggle("all") ? "Show fewer" : button.dataset.more;
  }));

  // Films.
  const frames = film => {
    const reel = make("div", { class: "reel" });
    if (!film.frames) {
      const shown = document.getElementById(film.id);
      if (shown) return find(".reel", shown).cloneNode(true);
      return reel;
    }
    film.frames.forEach((frame, index) => {
      const step = `step ${film.steps[index]}`;
      reel.append(make("div", {}, make("img", { src: "data:image/jpeg;base64," + frame, alt: step }),
        make("div", { class: "tag" }, step)));
    });
    return reel;
  };
  const pinned = find("#pinned");
  const strip = (group, film) => {
    const seed = group.cells[film.cell].seed, won = film.outcome.startsWith("success");
    const who = `start ${film.start}` + (seed === null ? "" : `, training seed ${seed}`) + `, seen by ${film.view}: `;
    const caption = make("figcaption", {}, who, make("span", { class: won ? "won" : "lost" }, film.outcome));
    const figure = make("figure", { class: "rollout", "data-film": film.id }, caption, frames(film));
    const pin = make("button", { class: "button pin", type: "button" }, "Add to comparison");
    pin.addEventListener("click", () => {
      const copy = make("figure", { class: "rollout" }, make("figcaption", {}, `${group.task}, ${group.title}: ${who}`,
        make("span", { class: won ? "won" : "lost" }, film.outcome)), frames(film));
      const off = make("button", { class: "button pin", type: "button" }, "Remove");
      off.addEventListener("click", () => { copy.remove(); pinned.hidden = !find("figure", pinned); });
      copy.firstChild.append(off);
      pinned.append(copy);
      pinned.hidden = false;
      pin.textContent = "Added to comparison ✓";
    });
    caption.append(pin);
    return figure;
  };

  // A cell's episodes.
  const dialog = find("#episodes");
  const squares = (group, cell, index) => {
    const box = make("div", { class: "squares" });
    [...cell.outcomes].forEach((letter, at) => {
      const kind = KINDS[letter] || KINDS.e;
      const start = Array.isArray(cell.starts) ? cell.starts[at] : cell.starts + at;
      const end = [cell.mm[at] === null ? "" : `${cell.mm[at]} mm`, cell.deg[at] === null ? "" : `${cell.deg[at]}°`];
      const where = end.filter(Boolean).join(" and ");
      const words = `start ${start}: ${kind.name} after ${cell.steps[at]} steps` + (where && `, ${where} from the goal`);
      const film = group.films.find(item => item.cell === index && item.start === start);
      const square = make("button", { type: "button", title: words, "aria-label": words, style: `background:${kind.colour}` },
        letter === "s" ? "✓" : letter);
      if (kind.dark) square.classList.add("dark");
      square.addEventListener("click", () => {
        const line = square.closest("section").querySelector(".said");
        line.textContent = words;
        if (film) find(`[data-film="${film.id}"]`, dialog)?.scrollIntoView({ block: "nearest" });
      });
      if (film) square.classList.add("film");
      box.append(square);
    });
    return box;
  };
  const show = number => {
    const group = data[number];
    if (!group) return;
    const body = find("#episodes-body");
    body.replaceChildren();
    find("#episodes-title").textContent = `${group.task}: ${group.title}`;
    if (group.count) {
      const line = `${group.count}, 95 % interval ${group.interval}` + (group.across && `; across training seeds ${group.across}`);
      body.append(make("p", { class: "lead" }, line));
    }
    for (const cell of group.missing) {
      body.append(make("p", {}, make("span", { class: `state ${cell.state}` }, cell.state), ` training seed ${cell.seed}: `, cell.reason));
    }
    const seen = [...new Set(group.cells.map(cell => cell.outcomes).join(""))];
    if (seen.length) {
      const key = make("p", { class: "key soft" });
      for (const letter of Object.keys(KINDS).filter(letter => seen.includes(letter))) {
        const mark = make("span", {}, make("i", { style: `background:${KINDS[letter].colour}` }));
        mark.append((letter === "s" ? "✓ " : letter + " ") + KINDS[letter].name);
        key.append(mark);
      }
      body.append(key);
    }
    group.cells.forEach((cell, index) => {
      const head = (cell.seed === null ? "" : `Training seed ${cell.seed}: `) + `${cell.count} (${cell.interval})`;
      const said = make("p", { class: "note said", "aria-live": "polite" }, "One square per episode, in the order of the starts; a ringed one has a film below.");
      const facts = make("dl");
      for (const [name, value] of cell.facts) facts.append(make("dt", {}, name), make("dd", {}, make("code", {}, value)));
      const origin = make("details", {}, make("summary", {}, "How to reproduce this number"),
        ...cell.commands.map(command => make("code", { class: "command" }, command)), facts);
      body.append(make("section", {}, make("h3", {}, head), squares(group, cell, index), said, origin));
    });
    if (group.films.length) body.append(make("h3", {}, "Films"), ...group.films.map(film => strip(group, film)));
    else if (group.cells.length) body.append(make("p", { class: "note" }, "No film of this cell is on the page."));
    if (group.measures.length) {
      const list = make("dl");
      for (const [name, value] of group.measures) list.append(make("dt", {}, name), make("dd", {}, value));
      body.append(make("h3", {}, "Measured"), list);
    }
    if (!dialog.open) dialog.showModal();
    dialog.scrollTop = 0;
    history.replaceState(null, "", `#cell-${number}`);
  };
  all("[data-group]").forEach(node => {
    node.tabIndex = 0;
    node.addEventListener("click", () => show(Number(node.dataset.group)));
    node.addEventListener("keydown", event => {
      if (event.key === "Enter" || event.key === " ") { event.preventDefault(); show(Number(node.dataset.group)); }
    });
  });
  find("#close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", event => { if (event.target === dialog) dialog.close(); });
  dialog.addEventListener("close", () => history.replaceState(null, "", location.pathname + location.search));
  const wanted = /^#cell-(\d+)$/.exec(location.hash);
  filter();
  if (wanted) show(Number(wanted[1]));
})();
