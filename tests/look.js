// Looks at pages from inside their frames, and leaves what it saw in the document. A frame is as
// narrow as it is told to be; a window is not.
const look = (frame) => {
  const page = frame.contentDocument, seen = {cut: [], silent: [], pictures: 0};
  const width = frame.contentWindow.innerWidth;
  const says = (e) => e.tagName + "." + e.className + ": " + e.textContent.trim().slice(0, 40);
  seen.width = width;
  seen.scroll = page.documentElement.scrollWidth;
  for (const e of page.querySelectorAll("body *:not(svg *)")) {
    const box = e.getBoundingClientRect();
    if (box.right > width + 0.5 || box.left < -0.5) seen.cut.push(says(e));
    if (e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0) seen.cut.push(says(e));
  }
  for (const svg of page.querySelectorAll("svg")) {
    seen.pictures += 1;
    const whole = svg.getBoundingClientRect();
    for (const e of svg.querySelectorAll("g[id^=text_]")) {
      const box = e.getBoundingClientRect();
      const out = Math.max(whole.left - box.left, box.right - whole.right,
                           whole.top - box.top, box.bottom - whole.bottom);
      if (out > 1) seen.cut.push("picture of " + svg.closest("figure").id + ": " + e.id);
    }
    const figure = svg.closest("figure"), text = figure && figure.querySelector("figcaption");
    const named = svg.closest("[role=img]");
    const told = text && text.innerText.trim().length > 40 && text.offsetHeight > 0;
    if (!told || !named || !named.getAttribute("aria-label")) seen.silent.push(svg.id);
    const beside = told && text.getBoundingClientRect().left >= whole.right - 1;
    if (width > 1000 && !beside) seen.silent.push("not beside: " + figure.id);
  }
  return seen;
};
onload = () => {
  const all = [...document.querySelectorAll("iframe")].map(look);
  document.body.textContent = "seen " + JSON.stringify(all) + " end";
};
