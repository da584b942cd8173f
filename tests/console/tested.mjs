/** What the tests of one file look at: a service, a browser and, where it is asked for, a sweep to upload. */

import { after, afterEach, before } from "node:test";

import { launch, Service } from "./harness.mjs";
import { makeSweep } from "./sweep.mjs";

/** Starts them before the first test of the file and ends them after the last one; pages are closed after each test.
 *
 * Gives { service, browser, files }, filled in before the tests. `environment`: settings of the service; `prepare`: what
 * is done with all of it first.
 */
export function tested({ environment = {}, sweep = false, prepare = async () => undefined } = {}) {
  const at = {};
  before(async () => {
    if (sweep) at.files = makeSweep();
    at.service = await Service.start(environment);
    at.browser = await launch();
    await prepare(at);
  });
  afterEach(() => Promise.all(at.browser.contexts().map((context) => context.close())));
  after(async () => {
    await at.browser?.close();
    await at.service?.stop();
    at.files?.remove();
  });
  return at;
}
