/** Writes what the console knows of the service, from its OpenAPI document: types, and descriptions to draw forms from.
 *
 * `npm run generate`; `build`, `check` and `dev` do it first. A document that is not that of the service fails
 * tests/documents/test_snapshots.py.
 */

import { existsSync, mkdirSync, readFileSync, writeFileSync } from "node:fs";
import openapiTS, { astToString } from "openapi-typescript";

const FOLDER = new URL("src/api/generated/", import.meta.url);
const KEPT = ["description", "default", "minimum", "exclusiveMinimum", "maximum", "minItems", "maxItems", "enum", "const", "examples", "x-numbers"];

const document = JSON.parse(readFileSync(new URL("openapi.json", import.meta.url), "utf8"));
const { schemas } = document.components;

/** A JSON schema with its references filled in, as far as a form needs it: see `Described` of web/src/api/described.ts. */
function described({ $ref, anyOf, oneOf, properties, prefixItems, items = prefixItems?.[0], ...schema }) {
  const kept = Object.fromEntries(Object.entries(schema).filter(([key]) => KEPT.includes(key)));
  if (kept.enum) kept.enum = kept.enum.filter((one) => one !== null); // then it is nullable
  if ($ref) return { ...described(schemas[$ref.split("/").at(-1)]), ...kept };
  if (anyOf) {
    const [one, ...others] = anyOf.filter(({ type }) => type !== "null");
    if (others.length === 0) return { ...described(one), ...kept, nullable: true };
  }
  const type = schema.type && { type: schema.type };
  const fields = properties && {
    properties: Object.fromEntries(Object.entries(properties).map(([name, value]) => [name, described(value)])),
  };
  return { ...type, ...kept, ...fields, ...(items && { items: described(items) }), ...(oneOf && { oneOf: oneOf.map(described) }) };
}

/** An object with some of its fields. */
function only({ properties, ...schema }, names) {
  return { ...schema, properties: Object.fromEntries(names.map((name) => [name, properties[name]])) };
}

/** The query parameters of a route. */
function queryOf({ parameters }) {
  const asked = parameters.filter((one) => one.in === "query");
  return Object.fromEntries(asked.map(({ name, schema }) => [name, described(schema)]));
}

/** The specification of each kind of job. */
function jobKinds({ kind, specification }) {
  return Object.fromEntries(kind.enum.map((one, index) => [one, described(specification.anyOf[index])]));
}

/** What each operation of the service needs: "POST /v1/jobs" → its role, and whether what it names must be one's own. */
function operations(paths) {
  const all = Object.entries(paths).flatMap(([path, methods]) =>
    Object.entries(methods).map(([method, told]) => [`${method.toUpperCase()} ${path}`, told]),
  );
  const ruled = all.filter(([, told]) => told["x-role"] !== undefined);
  return Object.fromEntries(ruled.map(([name, told]) => [name, { role: told["x-role"], owned: told["x-owned"] }]));
}

/** What of a plan is asked for by a form, in its order. */
const PLANNED = ["want", "within_mm", "views", "path_mm", "region_mm", "label", "box_mm", "tilt_deg", "rock_deg", "turn_deg"];
/** Of which several edits have one: written once. */
const shapes = JSON.stringify(described(schemas.InsertEdit.properties.shape).oneOf);
const contract = (text) => `import type { Described } from "../described";\n\n${text}`;
/** What every view needs is apart from what only some do, so that the page begins with less. */
const texts = {
  "schema.d.ts": astToString(await openapiTS(structuredClone(document))),
  "contract.ts": contract(`export const settings: Described = ${JSON.stringify(described(schemas.RenderSettings), null, 1)};
export const outputs: Described = ${JSON.stringify(described(schemas.Scene.properties.outputs), null, 1)};
export const within: Described = ${JSON.stringify(described(only(schemas.LocalizeBody, ["within_mm", "within_deg"])), null, 1)};
export const planSettings: Described = ${JSON.stringify(described(only(schemas.PlanBody, PLANNED)), null, 1)};
export const namedProbes = ${JSON.stringify(schemas.Probe["x-named"], null, 1)};
export const renderedAs: Described = ${JSON.stringify(described(schemas.RenderSpecification.properties.format), null, 1)};
export const roles = ${JSON.stringify(schemas.Role.enum)} as const;
export const operations = ${JSON.stringify(operations(document.paths), null, 1)} as const;
`),
  "work.ts": contract(`/** What a job of each kind is specified by. */
export const JOB_KINDS: ReadonlyMap<string, Described> = new Map(Object.entries(${JSON.stringify(jobKinds(schemas.JobBody.properties), null, 1)} as Record<string, Described>));
export const trainingSettings: Described = ${JSON.stringify(described(schemas.TrainingConfig), null, 1)};
export const trainingPresets: Record<string, Record<string, unknown>> = ${JSON.stringify(schemas.TrainingConfig["x-presets"], null, 1)};
export const uploadOptions: Record<string, Described> = ${JSON.stringify(queryOf(document.paths["/v1/datasets/{dataset}"].put), null, 1)};
`),
  "edits.ts": contract(`const shapes: Described[] = ${shapes};
export const edits: Described = ${JSON.stringify(described(schemas.EditBody.properties.edits)).replaceAll(shapes, "shapes")};
`),
};
mkdirSync(FOLDER, { recursive: true });
for (const [name, text] of Object.entries(texts)) {
  const file = new URL(name, FOLDER);
  if (!existsSync(file) || readFileSync(file, "utf8") !== text) writeFileSync(file, text); // what is as it was is not built anew
}
