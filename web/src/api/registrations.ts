/** Registrations: how the poses of a robot or a tracker lead into a scene. */

import { getJson, remove, type Schemas } from "./client";

export type Registration = Schemas["NamedRegistration"];

/** Every registration of the service, by name. */
export async function listRegistrations(signal: AbortSignal): Promise<Registration[]> {
  const all: Registration[] = [];
  let token = "";
  do {
    const page = await getJson("/v1/registrations", {}, { query: { page_size: "1000", page_token: token }, signal });
    all.push(...page.registrations);
    token = page.next_page_token;
  } while (token !== "");
  return all;
}

export function deleteRegistration(registration: string): Promise<void> {
  return remove("/v1/registrations/{registration}", { registration });
}
