/** When the 3D view draws, and how soon a click in it shows. */

/** To run before a page's own scripts: keeps what WebGL has drawn readable, and notes when each drawing began and ended. */
export function watchDrawing() {
  const { getContext } = HTMLCanvasElement.prototype;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return getContext.call(this, kind, kind === "webgl2" ? { ...options, preserveDrawingBuffer: true } : options);
  };
  globalThis.drawings = [];
  const { fenceSync, deleteSync } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.fenceSync = function (...given) {
    const fence = fenceSync.apply(this, given);
    globalThis.drawings.push({ fence, began: performance.now(), ended: null });
    return fence;
  };
  WebGL2RenderingContext.prototype.deleteSync = function (fence) {
    const drawing = globalThis.drawings.find((one) => one.fence === fence);
    if (drawing) [drawing.ended, drawing.fence] = [performance.now(), null];
    return deleteSync.call(this, fence);
  };
}

/** Milliseconds from a click in the options of the 3D view until it is drawn, of as many clicks, the shortest first. */
export async function clicksShownAfter_ms(page, clicks) {
  const times_ms = [];
  for (let i = 0; i < clicks; i++) {
    const shownAfter_ms = page.getByLabel(i % 2 ? "Sweep" : "Skin", { exact: true }).evaluate(async (element) => {
      const start = performance.now();
      element.click();
      for (;;) {
        await new Promise((resolve) => requestAnimationFrame(resolve));
        const shown = globalThis.drawings.find(({ began, ended }) => began >= start && ended !== null);
        if (shown) return shown.ended - start;
      }
    });
    times_ms.push(await shownAfter_ms);
    await page.waitForTimeout(400);
  }
  return times_ms.sort((a, b) => a - b);
}
