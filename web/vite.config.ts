import { readFileSync } from "node:fs";
import { svelte } from "@sveltejs/vite-plugin-svelte";
import { defineConfig, type Plugin } from "vite";

// `npm run dev` serves the sources and passes on what is asked of the API to a service that runs.
const LEAST_CHUNK_BYTES = 20_000; // each request takes its time
const FIRST_VIEW = "/scan/Scan.svelte";
const service = process.env.ULTRAGRAY_ADDRESS ?? "http://127.0.0.1:8000";

/** The licences of what is bundled, which ask to come along. */
function licences(): Plugin {
  const files = ["svelte/LICENSE.md", "three/LICENSE"];
  return {
    name: "licences",
    generateBundle() {
      const texts = files.map((file) => `${file}\n\n${readFileSync(`node_modules/${file}`, "utf8")}`);
      this.emitFile({ type: "asset", fileName: "licences.txt", source: texts.join("\n\n") });
    },
  };
}

/** The view that a page opens with is fetched beside what shows it. */
function firstViewAhead(): Plugin {
  return {
    name: "first-view-ahead",
    transformIndexHtml: {
      order: "post",
      handler(_, { bundle = {} }) {
        const chunk = Object.values(bundle).find((one) => one.type === "chunk" && one.facadeModuleId?.endsWith(FIRST_VIEW));
        if (chunk?.type !== "chunk") return [];
        const isAsked = (name: string): boolean => bundle[name]?.type === "chunk" && bundle[name].isEntry;
        const chunks = [chunk, ...chunk.imports.filter((name) => !isAsked(name)).map((name) => bundle[name])].filter((one) => one?.type === "chunk");
        return chunks.map(({ fileName }) => ({ tag: "link", attrs: { rel: "modulepreload", crossorigin: true, href: `/${fileName}` }, injectTo: "head" }));
      },
    },
  };
}

export default defineConfig({
  plugins: [svelte(), licences(), firstViewAhead()],
  build: {
    outDir: "../service/ultragray_service/console",
    emptyOutDir: true,
    assetsInlineLimit: 0, // the Content-Security-Policy allows no data: URLs
    modulePreload: { polyfill: false },
    target: "es2022",
    cssCodeSplit: false, // one small file
    chunkSizeWarningLimit: 800,
    rollupOptions: { output: { experimentalMinChunkSize: LEAST_CHUNK_BYTES } },
  },
  server: {
    host: "127.0.0.1",
    proxy: { "/v1": { target: service, ws: true, changeOrigin: true, headers: { origin: service } } },
  },
});
