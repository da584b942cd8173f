import { readFileSync } from "node:fs";
import { svelte } from "@sveltejs/vite-plugin-svelte";
import { defineConfig, type Plugin } from "vite";

// What nearly all views need, as one file: each request takes its time.
const COMMON = /\/src\/(api|geometry|page|session|shared)\/(?!generated\/work)/;
const FIRST_VIEW = "/scan/Scan.svelte";
// `npm run dev` serves the sources and passes on what is asked of the API to a service that runs.
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
        const chunks = Object.values(bundle).filter((one) => one.type === "chunk");
        const first = chunks.find(({ facadeModuleId }) => facadeModuleId?.endsWith(FIRST_VIEW));
        const asked = chunks.filter(({ isEntry }) => isEntry).flatMap(({ fileName, imports }) => [fileName, ...imports]);
        const files = first === undefined ? [] : [first.fileName, ...first.imports].filter((file) => !asked.includes(file));
        return files.map((file) => ({ tag: "link", attrs: { rel: "modulepreload", crossorigin: true, href: `/${file}` }, injectTo: "head" }));
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
    rollupOptions: { output: { manualChunks: (id) => (COMMON.test(id) ? "common" : undefined) } },
  },
  server: {
    host: "127.0.0.1",
    fs: { allow: [".."] }, // poses are those of `browser`
    proxy: { "/v1": { target: service, ws: true, changeOrigin: true, headers: { origin: service } } },
  },
});
