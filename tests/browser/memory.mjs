/** The memory of a page that renders: what its process has, what waits for the garbage collector, and the renderer's own. */

import { appendFileSync, readFileSync } from "node:fs";
import path from "node:path";

/** Has the workers of the pages in a folder tell the renderer's memory. */
export function watchRenderer(folder) {
  const watched = `
const instantiate = WebAssembly.instantiate;
WebAssembly.instantiate = async (...given) => {
  const instance = await instantiate(...given);
  globalThis.rendererMemory = instance.exports.memory;
  return instance;
};`;
  appendFileSync(path.join(folder, "worker.js"), watched);
}

export class Memory {
  static async of(browser, page) {
    const memory = new Memory();
    memory.page = page;
    memory.browser = await browser.newBrowserCDPSession();
    memory.session = await page.context().newCDPSession(page);
    return memory;
  }

  /** Of the largest process of pages, its workers with their scenes among it, MiB. */
  async resident() {
    const { processInfo } = await this.browser.send("SystemInfo.getProcessInfo");
    const renderers = processInfo.filter(({ type }) => type === "renderer");
    return Math.max(...renderers.map(({ id }) => Number(/VmRSS:\s+(\d+)/.exec(readFileSync(`/proc/${id}/status`, "utf8"))?.[1] ?? 0))) / 1024;
  }

  /** Of the renderers in the page's workers, MiB. */
  async renderer() {
    const sizes = await Promise.all(this.page.workers().map((worker) => worker.evaluate(() => globalThis.rendererMemory.buffer.byteLength)));
    return sizes.reduce((sum, size) => sum + size, 0) / 2 ** 20;
  }

  /** Of objects and buffers that the page still holds, MiB: the garbage is collected first. */
  async held() {
    await this.session.send("HeapProfiler.collectGarbage");
    const { usedSize, backingStorageSize } = await this.session.send("Runtime.getHeapUsage");
    return (usedSize + backingStorageSize) / 2 ** 20;
  }
}
