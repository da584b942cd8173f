/** What of a page people can reach: with the eye, the pointer, a finger, the keyboard. */

const ACTIVE = "a[href], button, input, select, textarea, summary, [tabindex='0']";

/** Descriptions of what lies beside the screen, or is cut by something that does not scroll. */
export function cut(page) {
  return page.evaluate(() => {
    const { innerWidth } = globalThis;
    const named = (one) => `${one.tagName.toLowerCase()} ${one.getAttribute("aria-label") ?? one.textContent.trim().slice(0, 40)}`;
    const found = [];
    if (document.documentElement.scrollWidth > innerWidth) found.push(`the page is ${document.documentElement.scrollWidth} px wide`);
    const scrolls = (one) => ["auto", "scroll"].includes(getComputedStyle(one).overflowX);
    for (const one of document.querySelectorAll("body *")) {
      const box = one.getBoundingClientRect();
      if (box.width <= 1 || box.height <= 1 || one.closest("[aria-hidden=true]")) continue;
      if (getComputedStyle(one).clipPath !== "none" || !one.checkVisibility()) continue;
      if (box.right <= innerWidth + 1 && box.left >= -1) continue;
      let above = one.parentElement;
      while (above && !scrolls(above)) above = above.parentElement;
      if (!above) found.push(named(one));
    }
    for (const text of document.querySelectorAll("svg text")) {
      const [box, drawing] = [text, text.ownerSVGElement].map((one) => one.getBoundingClientRect());
      if (text.checkVisibility() && (box.right > drawing.right + 1 || box.left < drawing.left - 1)) found.push(`the text ${text.textContent}`);
    }
    return found;
  });
}

/** Descriptions of what is there to be worked with, and cannot be pointed at however one scrolls. */
export function unreachable(page) {
  return page.evaluate(async (active) => {
    const found = [];
    for (const one of document.querySelectorAll(active)) {
      const isSeen = one.checkVisibility() && !one.disabled && one.getBoundingClientRect().width > 1;
      if (!isSeen || one.closest(".visually-hidden, [aria-hidden=true]") || getComputedStyle(one).clipPath !== "none") continue;
      one.scrollIntoView({ block: "center", inline: "center", behavior: "instant" });
      const box = one.getBoundingClientRect();
      const hit = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
      if (one.matches("[role=group], main, section") ? hit === null : !(one.contains(hit) || hit?.contains(one)))
        found.push(`${one.tagName.toLowerCase()} ${one.getAttribute("aria-label") ?? one.textContent.trim().slice(0, 40)} at ${box.left | 0},${box.top | 0}`);
    }
    for (const one of document.querySelectorAll("*")) one.scrollTop &&= 0;
    return found;
  }, ACTIVE);
}

/** Descriptions of targets below `least` px in both directions; what is in the text of a sentence may be. */
export function small(page, least) {
  return page.evaluate(
    ([active, least]) => {
      const found = [];
      for (const one of document.querySelectorAll(active)) {
        if (!one.checkVisibility() || one.disabled || one.closest(".visually-hidden, [aria-hidden=true]")) continue;
        if (one.matches("p a, dd a, li p a, [role=group], canvas") || getComputedStyle(one).clipPath !== "none") continue;
        const target = one.matches("input[type=checkbox], input[type=radio], input[type=file]") ? (one.closest("label") ?? one) : one;
        const { width, height } = target.getBoundingClientRect();
        if (width <= 1) continue;
        if (height < least - 0.5 || width < Math.min(least, 44) - 0.5)
          found.push(`${one.tagName.toLowerCase()} ${one.getAttribute("aria-label") ?? one.textContent.trim().slice(0, 30)} ${width | 0}x${height | 0}`);
      }
      return found;
    },
    [ACTIVE, least],
  );
}

/** Walks with Tab from the begin of the page to its end; what can be worked with and was not reached, or is not seen to have the focus. */
export async function walk(page, most = 250) {
  await page.evaluate((active) => {
    document.activeElement?.blur();
    scrollTo(0, 0);
    let number = 0;
    for (const one of document.querySelectorAll(active)) {
      const isChoice = one.type === "radio" && !one.checked;
      const isSeen = one.checkVisibility() && one.getBoundingClientRect().width > 0;
      if (isSeen && !one.disabled && one.tabIndex >= 0 && !isChoice) one.dataset.walked = String(number++);
    }
  }, ACTIVE);
  const faults = [];
  for (let step = 0; step < most; step++) {
    await page.keyboard.press("Tab");
    const at = await page.evaluate(() => {
      const one = document.activeElement;
      if (one === document.body || one === null) return null;
      const wasHere = one.dataset.walked === "done";
      one.dataset.walked = "done";
      const told = `${one.tagName.toLowerCase()} ${one.getAttribute("aria-label") ?? one.textContent.trim().slice(0, 40)}`;
      const shown = one.classList.contains("visually-hidden") ? one.closest("label") ?? one : one;
      const { outlineStyle } = getComputedStyle(shown);
      const box = shown.getBoundingClientRect();
      const inSight = box.bottom > 0 && box.right > 0 && box.top < innerHeight && box.left < innerWidth;
      return { told, wasHere, isMarked: outlineStyle !== "none", inSight };
    });
    if (at === null || at.wasHere) break;
    if (!at.isMarked) faults.push(`no mark of the focus: ${at.told}`);
    if (!at.inSight) faults.push(`out of sight: ${at.told}`);
  }
  const missed = await page.evaluate(() => {
    const left = [...document.querySelectorAll("[data-walked]")].filter((one) => one.dataset.walked !== "done");
    const told = left.filter((one) => one.isConnected && one.checkVisibility() && !one.disabled)
      .map((one) => `${one.tagName.toLowerCase()} ${one.getAttribute("aria-label") ?? one.textContent.trim().slice(0, 40)}`);
    for (const one of document.querySelectorAll("[data-walked]")) delete one.dataset.walked;
    return told;
  });
  return [...faults, ...missed.map((one) => `never reached: ${one}`)];
}
