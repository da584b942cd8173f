/** People with keys of every role, for tests of what each of them sees. */

import { execFileSync } from "node:child_process";

import { openPage, PYTHON, SOURCES, until } from "./harness.mjs";

const COMMAND = "from ultragray_service.cli.app import app; app()";
const ROLES = { rita: "reader", alice: "operator", bob: "operator", admin: "admin" };

/** Gives each of them a key, as whoever runs the service does, and waits until it asks for one. */
export async function giveKeys(service) {
  const keys = {};
  for (const [name, role] of Object.entries(ROLES)) {
    const given = ["-c", COMMAND, "keys", "create", name, "--role", role, "--data-folder", service.data];
    const options = { env: { ...process.env, PYTHONPATH: SOURCES }, encoding: "utf8", stdio: ["ignore", "pipe", "ignore"] };
    keys[name] = execFileSync(PYTHON, given, options).trim();
  }
  const knows = ([, key]) => fetch(`${service.url}/v1/me`, { headers: { "X-API-Key": key } }).then(({ ok }) => ok);
  const all = () => Promise.all(Object.entries(keys).map(knows));
  await until(all, (known) => known.every(Boolean), "the service does not know the keys");
  await until(() => fetch(`${service.url}/v1/me`), ({ status }) => status === 401, "the service asks for no key");
  return keys;
}

/** A page of somebody who has given their key. */
export function pageOf(at, name, hash, options = {}) {
  const init = `sessionStorage.getItem("ultragray.key") ?? sessionStorage.setItem("ultragray.key", ${JSON.stringify(at.keys[name])})`;
  return openPage(at, hash, { ...options, init });
}

/** What the service answers somebody. */
export async function askAs(at, name, method, route, { body, type = "application/json" } = {}) {
  const headers = { "X-API-Key": at.keys[name], ...(body && { "Content-Type": type }) };
  const answer = await fetch(`${at.service.url}${route}`, { method, headers, body });
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}
