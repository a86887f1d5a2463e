// The page: log-in, screens and keys; everything else is in the modules.

import { Aim } from "./aim.js";
import { Band } from "./band.js";
import { Calibrate } from "./calibrate.js";
import { showHealth, showSetup } from "./facts.js";
import { Glimpse } from "./glimpse.js";
import { Checkup, Latencies, LogTail } from "./health.js";
import { Link, ask } from "./link.js";
import { Recordings } from "./recordings.js";
import { Watch } from "./watch.js";
import { $ } from "./words.js";

const SCREENS = ["watch", "aim", "recordings", "health", "setup"];
const link = new Link(), logTail = new LogTail(), latencies = new Latencies(), checkup = new Checkup(fail), band = new Band(), watch = new Watch(fail), aim = new Aim(), calibrate = new Calibrate(fail), recordings = new Recordings(fail);
new Glimpse(link);
let operator = false, setup = null, latest = null, run = null;

function fail(text) { $("error").textContent = text; $("error").hidden = !text; }

function stale(why) { band.stale(why); watch.stale(why); calibrate.stale(why); }

async function enter(token) {
  await ask("POST", "session", { token });
  await admitted();
}

async function admitted() {
  const { role } = await ask("GET", "whoami");
  operator = role === "operator";
  await ask("GET", "setup").then((facts) => { setup = facts; }, () => {});
  watch.enter(operator, setup); recordings.enter(operator); calibrate.enter(operator); checkup.enter(operator);
  $("enter").close();
  screen();
}

/** Show the screen named after # in the address. */
function screen() {
  const asked = location.hash.replace("#/", ""), shown = SCREENS.includes(asked) ? asked : "watch";
  for (const name of SCREENS) $(name).hidden = name !== shown;
  for (const anchor of document.querySelectorAll("nav a")) if (anchor.dataset.screen === shown) anchor.setAttribute("aria-current", "page"); else anchor.removeAttribute("aria-current");
  if (shown === "health") { logTail.show(); if (setup) checkup.show(); }
  if (latest) latencies.show(latest.status, latest.live_error);
  if (shown === "recordings") recordings.show();
  if (shown === "aim" && setup) calibrate.open();
  if (shown === "setup") ask("GET", "setup").then((facts) => { setup = facts; showSetup(setup, latest?.status); }, (error) => fail(error.message));
  if (latest) showHealth(latest.status, latest.health, fail, operator);
}

/** A late answer to a request from before the log-in may have opened the dialog again: the session closes it. */
link.addEventListener("begun", () => { if (!setup || $("enter").open) admitted().catch(() => {}); });
link.addEventListener("locked", () => { if (!$("enter").open) $("enter").showModal(); });
link.addEventListener("silent", ({ detail }) => stale(`The page's server has not sent anything for ${Math.round(detail)} s.`));
link.addEventListener("link", ({ detail }) => stale(`The page's server cannot reach the daemon: ${detail.header.why}`));
link.addEventListener("news", ({ detail }) => {
  watch.news(detail.header.news);
  if (detail.header.news.kind === "reload" && !$("setup").hidden) screen();
});
link.addEventListener("rows", ({ detail }) => { watch.rows(detail.header, detail.body); aim.rows(detail.header, detail.body); latencies.rows(detail.header); });
link.addEventListener("state", ({ detail }) => {
  latest = detail.header.state;
  // Arming makes the devices known that Setup shows.
  if (run !== (run = latest.status.run_id) && !$("setup").hidden) screen();
  band.show(latest.status, latest.health, latest.for_s);
  watch.show(latest.status, latest.live_error);
  aim.show(latest.status, latest.live_error);
  calibrate.show(latest.status);
  latencies.show(latest.status, latest.live_error);
  showHealth(latest.status, latest.health, fail, operator);
  if (!setup) admitted().catch(() => {});
});

addEventListener("hashchange", screen);
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]") || event.target.closest("input:not([type=checkbox]), select, textarea")) return;
  if (event.key === "?") { $("keys").showModal(); return; }
  const number = SCREENS[Number(event.key) - 1];
  if (number) { location.hash = `/${number}`; return; }
  const onButton = event.target.closest("button, a, input") && [" ", "Enter"].includes(event.key);
  if (onButton || event.repeat) return;
  const played = !$("recordings").hidden && recordings.key(event.key);
  if (played || watch.key(event.key.toLowerCase())) event.preventDefault();
});
addEventListener("keyup", (event) => { if (event.key.toLowerCase() === "s") watch.releaseStop(); });
$("help").onclick = () => $("keys").showModal();
$("theme").onclick = () => {
  const dark = document.documentElement.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  localStorage.setItem("theme", document.documentElement.dataset.theme = dark === "dark" ? "light" : "dark");
};
$("enter").addEventListener("cancel", (event) => event.preventDefault());
$("enter").querySelector("form").addEventListener("submit", (event) => {
  event.preventDefault();
  enter($("token").value).then(() => { $("token").value = ""; }, (error) => { $("enter-error").textContent = error.message; });
});

if (localStorage.getItem("theme")) document.documentElement.dataset.theme = localStorage.getItem("theme");
const token = /^#token=([\w-]+)$/.exec(location.hash);
if (token) { history.replaceState(null, "", "#/watch"); await enter(token[1]).catch((error) => fail(error.message)); }
screen();
link.run();
