// Verdicts on the capture, the PSF and the picture, in words.

import { pageWords } from "./hints.js";

const WORDS = { good: "good", doubt: "doubtful", unknown: "cannot tell", bad: "bad", weak: "weak" };

// "psf, psf-gamma" as a title: "PSF, gamma".
function titled(text) {
  const words = text.replace(/^psf, psf-/, "psf, ").replace(/^psf/, "PSF").replace("exif", "EXIF orientation")
    .replace("little-", "detail ").replaceAll("-", " ");
  return words[0].toUpperCase() + words.slice(1);
}

function list(place, entries) {
  place.replaceChildren(...entries.map(([state, title, text]) => {
    const item = document.createElement("li");
    item.className = state;
    const strong = Object.assign(document.createElement("strong"), { textContent: `${title}: ${WORDS[state]}. ` });
    item.append(strong, pageWords(text));
    return item;
  }));
}

export function showVerdicts(report) {
  const section = document.getElementById("trust-section");
  section.hidden = !report.verdicts;
  if (!report.verdicts) return;
  document.getElementById("summary").textContent = `${report.doubtful ? "Doubtful" : "Consistent"}: ${report.summary}.`;
  const order = ["doubt", "unknown", "good"];
  const sorted = [...report.verdicts].sort((a, b) => order.indexOf(a.state) - order.indexOf(b.state));
  list(document.getElementById("verdicts"), sorted.map((v) => [v.state, titled(`${v.subject}, ${v.topic}`), v.options ? `${v.text} Try \`${v.options}\`.` : v.text]));
}

export function showFindings(report) {
  document.getElementById("headline").textContent = report.headline;
  list(document.getElementById("findings"), report.verdict.map((finding) => [finding.weight, "PSF", finding.text]));
}
