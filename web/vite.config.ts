import { readFileSync } from "node:fs";
import { svelte } from "@sveltejs/vite-plugin-svelte";
import { defineConfig, type Plugin } from "vite";

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

export default defineConfig({
  plugins: [svelte(), licences()],
  build: {
    outDir: "../service/ultragray_service/console",
    emptyOutDir: true,
    assetsInlineLimit: 0, // the Content-Security-Policy allows no data: URLs
    modulePreload: { polyfill: false },
    target: "es2022",
    chunkSizeWarningLimit: 800,
  },
  server: {
    host: "127.0.0.1",
    proxy: { "/v1": { target: service, ws: true, changeOrigin: true, headers: { origin: service } } },
  },
});
