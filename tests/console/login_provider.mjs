/** A login of a hospital for tests: discovery, keys, the page where people say who they are, and tokens. */

import { createHash, createSign, generateKeyPairSync, randomUUID } from "node:crypto";
import { createServer } from "node:http";

const KEY_ID = "one";
const LASTS_S = 3600;

export class LoginProvider {
  /** Of whoever signs in next; roles null: the token names none. */
  person = { name: "alice", roles: ["research"] };
  /** Why the next sign-in is refused; null: it is not. */
  refusal = null;
  renewals = 0;
  lasts_s = LASTS_S;
  #keys = generateKeyPairSync("rsa", { modulusLength: 2048 });
  #asked = new Map();

  static async start() {
    const provider = new LoginProvider();
    provider.server = createServer((request, answer) => void provider.#answer(request, answer));
    await new Promise((resolve) => provider.server.listen(0, "127.0.0.1", resolve));
    provider.url = `http://127.0.0.1:${provider.server.address().port}/realms/hospital`;
    return provider;
  }

  stop() {
    this.server.closeAllConnections();
    this.server.close();
  }

  /** Settings of a service that takes its tokens, and whose console signs people in with it. */
  settings() {
    return {
      ULTRAGRAY_OIDC_ISSUER: this.url,
      ULTRAGRAY_OIDC_AUDIENCE: "ultragray",
      ULTRAGRAY_OIDC_ROLES: "ultragray-admin=admin,research=operator,radiology=reader",
      ULTRAGRAY_OIDC_CLIENT_ID: "console",
    };
  }

  async #answer(request, answer) {
    const url = new URL(request.url, this.url);
    const json = (status, document) => {
      answer.writeHead(status, { "Content-Type": "application/json", "Access-Control-Allow-Origin": "*" });
      answer.end(JSON.stringify(document));
    };
    if (url.pathname.endsWith("/.well-known/openid-configuration"))
      return json(200, { issuer: this.url, jwks_uri: `${this.url}/certs`, authorization_endpoint: `${this.url}/auth`, token_endpoint: `${this.url}/token` });
    if (url.pathname.endsWith("/certs"))
      return json(200, { keys: [{ ...this.#keys.publicKey.export({ format: "jwk" }), kid: KEY_ID, use: "sig", alg: "RS256" }] });
    if (url.pathname.endsWith("/auth")) return this.#signIn(url.searchParams, answer);
    if (url.pathname.endsWith("/token")) return json(...(await this.#token(request)));
    json(404, {});
  }

  #signIn(query, answer) {
    const back = new URL(query.get("redirect_uri"));
    back.searchParams.set("state", query.get("state"));
    const code = randomUUID();
    this.#asked.set(code, { challenge: query.get("code_challenge"), redirect: query.get("redirect_uri") });
    if (this.refusal !== null) back.searchParams.set("error_description", this.refusal);
    back.searchParams.set(this.refusal === null ? "code" : "error", this.refusal === null ? code : "access_denied");
    answer.writeHead(302, { Location: back.href });
    answer.end();
  }

  async #token(request) {
    let body = "";
    for await (const part of request) body += part;
    const form = new URLSearchParams(body);
    const refused = (error) => [400, { error }];
    if (form.get("client_id") !== "console") return refused("invalid_client");
    if (form.get("grant_type") === "refresh_token") this.renewals += 1;
    else {
      const asked = this.#asked.get(form.get("code"));
      const challenge = createHash("sha256").update(form.get("code_verifier") ?? "").digest("base64url");
      if (!asked || asked.challenge !== challenge || asked.redirect !== form.get("redirect_uri")) return refused("invalid_grant");
      this.#asked.delete(form.get("code"));
    }
    // As Keycloak's: the token for services is for another audience, the one that says who somebody is for this client.
    const tokens = { access_token: this.#signed("account"), id_token: this.#signed("ultragray") };
    return [200, { ...tokens, refresh_token: randomUUID(), expires_in: this.lasts_s, token_type: "Bearer" }];
  }

  #signed(audience) {
    const now_s = Math.floor(Date.now() / 1000);
    const claims = { iss: this.url, aud: audience, sub: this.person.name, iat: now_s, exp: now_s + LASTS_S, roles: this.person.roles ?? undefined };
    const written = [{ alg: "RS256", kid: KEY_ID, typ: "JWT" }, claims].map((part) => Buffer.from(JSON.stringify(part)).toString("base64url")).join(".");
    return `${written}.${createSign("RSA-SHA256").update(written).sign(this.#keys.privateKey, "base64url")}`;
  }
}
