// Health and Setup: tables of the daemon's own reports.

import { ask } from "./link.js";
import { $, clock, count, duration, fill, make, quantity } from "./words.js";

export const table = (titles, rows) => make("div", { className: "scroll" }, make("table", {},
  make("tr", {}, ...titles.map((title) => make("th", { scope: "col" }, title))),
  ...rows.map((cells) => make("tr", {}, ...cells.map((cell) => make("td", {}, cell))))));
const panel = (title, ...children) => make("section", { className: "panel", "aria-label": title }, make("h2", {}, title), ...children);
const wide = (section) => { section.classList.add("whole"); return section; };
export const MARKS = { good: "✓ good", unknown: "· unknown", warning: "! warning", bad: "✗ bad" };

export function showHealth(status, health, fail, operator) {
  if ($("health").hidden) return;
  const capacity = status.capacity;
  const key = JSON.stringify([health, capacity, status.processes, status.uploads, status.recoveries, status.troubles, status.state, operator]);
  fill($("facts"), key, () => [make("div", { className: "panels" },
    wide(panel("Checks against fixed thresholds", table(["check", "", "now", "thresholds"], health.checks.map((check) =>
      [check.name, make("span", { className: check.level }, MARKS[check.level]), check.text, check.limit])))),
    panel("What this host sustains", capacity
      ? make("p", {}, capacity.warning ?? `${quantity(capacity.sustained_hz ?? 0, "lines/s")}; ${quantity(capacity.line_rate_hz, "lines/s")} are configured; the limit is: ${capacity.limit}.`, capacity.measured ? ` Measured on ${new Date(capacity.measured).toLocaleString("en-GB")}.` : "")
      : make("p", {}, "Not measured since the daemon started."),
    make("button", { id: "measure", disabled: !operator || status.state !== "idle" || Boolean(status.busy), onclick: () => { fail(""); ask("POST", "capacity").catch((error) => fail(error.message)); } }, "Measure now"),
    make("p", { className: "hint" }, "Only while the instrument is idle.")),
    panel("Processes", table(["name", "PID"], [["daemon", String(status.pid)], ...Object.entries(status.processes).map(([name, pid]) => [/^[ab]+$/.test(name) ? `grabber ${name}` : name, String(pid)])])),
    panel("Uploads", status.uploads.length ? table(["recording", "state", "lines uploaded", "reason"], status.uploads.map((one) => [one.path.split("/").at(-1), one.state, count(one.lines), one.error])) : make("p", {}, "None.")),
    panel("Recoveries", status.recoveries.length ? table(["recording", "state", ""], status.recoveries.map((one) => [one.path.split("/").at(-1), one.state, one.text])) : make("p", {}, "None.")),
    panel("Unexpected failures", status.troubles.length ? table(["last", "failure", "count"], status.troubles.map((one) => [clock(one.last), one.text, String(one.times)])) : make("p", {}, "None.")))]);
}

/** As armed last, each on a line of its own: model and version, serial number, and the trigger's port. */
function devices(found) {
  if (!found.length) return [make("p", {}, "Not known until the instrument is armed.")];
  const words = (one) => [[one.vendor, one.model].filter(Boolean).join(" ") || "model not stated",
    ...[["firmware", one.firmware], ["serial number", one.serial], ["at", one.port]].filter(([, value]) => value).map(([name, value]) => `${name} ${value}`)];
  return [make("dl", {}, ...found.flatMap((one) => [make("dt", {}, one.device), make("dd", {}, ...words(one).map((text) => make("div", {}, text)))])),
    make("p", { className: "hint" }, "As they described themselves when the instrument was last armed.")];
}

export function showSetup(setup, status) {
  if (!setup) return;
  const key = JSON.stringify([setup.config, setup.versions, setup.devices, status?.pid]);
  fill($("setup"), key, () => [make("div", { className: "panels" },
    panel("Changes from the defaults", make("p", {}, `Rig ${setup.name}, from ${setup.file || "no file"}. To change it, edit the file and restart the daemon.`),
      table(["key", "value"], Object.entries(setup.changed).map(([name, value]) => [name, JSON.stringify(value)]))),
    panel("Devices", ...devices(setup.devices)),
    panel("Versions", table(["library", "version"], Object.entries(setup.versions))),
    panel("Lines", table(["", ""], [["rate", quantity(setup.line_rate_hz, "lines/s")], ["period set by the trigger", quantity(setup.line_period_ns / 1e9, "s")], ["the rings hold", duration(setup.history_s)]])),
    wide(panel("Complete configuration", make("pre", { tabIndex: 0 }, JSON.stringify(setup.config, null, 2)))))]);
}
