/** Signing in at the login of the hospital instead of with a key. */

import assert from "node:assert/strict";
import { after, afterEach, before, describe, it } from "node:test";

import { canvasState, launch, openPage, picture, seriousFindings, Service, until } from "./harness.mjs";
import { LoginProvider } from "./login_provider.mjs";

const at = {};
before(async () => {
  at.provider = await LoginProvider.start();
  at.service = await Service.start(at.provider.settings());
  at.browser = await launch();
  const known = () => fetch(`${at.service.url}/v1/sign-in`).then((answer) => answer.json());
  await until(known, ({ provider }) => provider !== null, "the service does not know the login");
});
afterEach(() => Promise.all(at.browser.contexts().map((context) => context.close())));
after(async () => {
  await at.browser?.close();
  await at.service?.stop();
  at.provider?.stop();
});

const signIn = (page) => page.getByRole("button", { name: /^Sign in at 127\.0\.0\.1/ }).click();

describe("the login", () => {
  it("opens the page that was asked for, tells who it is, and leaves no code in the address", async () => {
    const page = await openPage(at, "#/maps/demo");
    await page.getByText("This service asks for a key").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "login");
    await signIn(page);
    await page.getByRole("button", { name: "Your key: alice operator" }).waitFor();
    await until(() => canvasState(page, '[data-testid="map-echo"]'), ({ mean }) => mean > 1, "no map came");
    assert.equal(new URL(page.url()).search, "");
    assert.ok(page.url().includes("#/maps/demo"));
    assert.deepEqual(page.faults.filter((fault) => !/401|Authentication/.test(fault)), []); // before, and one of two tokens
    await page.reload();
    await page.getByRole("button", { name: "Your key: alice operator" }).waitFor();
    await page.getByRole("button", { name: "Your key: alice operator" }).click();
    await page.getByRole("button", { name: "Use another key" }).click();
    await page.getByText("This service asks for a key").waitFor();
  });

  it("is asked for another token before the first one ends", async () => {
    at.provider.lasts_s = 31;
    const page = await openPage(at, "#/scenes");
    await signIn(page);
    await page.getByRole("button", { name: "Your key: alice operator" }).waitFor();
    await until(() => at.provider.renewals, (count) => count >= 1, "no token was renewed");
    at.provider.lasts_s = 3600;
    await page.getByText("Service ready").waitFor();
  });

  it("says what went wrong, and lets people try again", async () => {
    at.provider.refusal = "The user cancelled";
    const page = await openPage(at, "#/scenes");
    await signIn(page);
    await page.getByRole("alert").getByText("Signing in failed: The user cancelled").waitFor();
    at.provider.refusal = null;
    at.provider.person = { name: "guest", roles: ["visitors"] };
    await signIn(page);
    await page.getByRole("alert").getByText("holds nothing that gives a role here").waitFor();
    at.provider.person = { name: "chief", roles: ["ultragray-admin"] };
    await signIn(page);
    await page.getByRole("button", { name: "Your key: chief admin" }).waitFor();
    await page.getByTestId("audit").getByRole("heading", { name: "Audit log" }).waitFor();
  });

  it("believes no code that this tab did not ask for", async () => {
    const page = await openPage(at, "?code=stolen&state=guessed#/scenes");
    await page.getByRole("alert").getByText("this tab did not ask for it").waitFor();
    assert.equal(new URL(page.url()).search, "");
  });
});
