/** How people sign in where the service takes tokens of a login beside keys. */

import { getJson, type Schemas } from "./client";

export type SignInProvider = Schemas["SignInProvider"];

/** null: with keys alone. */
export async function signInProvider(): Promise<SignInProvider | null> {
  return (await getJson("/v1/sign-in", {})).provider;
}
