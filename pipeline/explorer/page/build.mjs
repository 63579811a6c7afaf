// Builds the page into ../static: `node build.mjs`, or with --check only says whether that is what lies there.

import { build } from "esbuild";
import { existsSync } from "node:fs";
import { mkdir, readFile, readdir, writeFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const STATIC = join(here, "..", "static");

/** What each script of the page begins with, and its format: a notebook imports a module. */
const ENTRIES = {
  explorer: ["src/main.js", "iife"], "explorer-folder": ["src/main-folder.js", "iife"], "explorer-widget": ["src/main-widget.js", "esm"],
};

/** Style sheets in the order in which they apply. */
const STYLES = ["explorer.css", "panels.css"];

/** Packages whose code is in the scripts, with their licences. */
const VENDORED = ["zarrita", "@zarrita/storage", "numcodecs", "reference-spec-reader", "unzipit", "fflate"];

const OPTIONS = {
  bundle: true, minify: true, target: ["es2022"], charset: "utf8", legalComments: "none",
  write: false, absWorkingDir: here, logLevel: "warning", metafile: true,
  // WebAssembly of codecs that exported cubes do not use
  alias: Object.fromEntries(["blosc", "lz4", "zstd"].map((codec) => [`numcodecs/${codec}`, "./src/other-codecs.js"])),
};

/** `import text from "worker:./x.js"` gives the bundled source of a worker: a page may make one only of a blob. */
const workers = {
  name: "workers",
  setup(builder) {
    builder.onResolve({ filter: /^worker:/ }, ({ path, resolveDir }) => ({
      path: join(resolveDir, path.slice("worker:".length)), namespace: "worker",
    }));
    builder.onLoad({ filter: /./, namespace: "worker" }, async ({ path }) => {
      const { outputFiles } = await build({ ...OPTIONS, format: "iife", entryPoints: [path] });
      return { contents: outputFiles[0].text, loader: "text" };
    });
  },
};

/** `import text from "styles:"` gives the style sheet, for a shadow root. */
const sheet = {
  name: "styles",
  setup(builder) {
    builder.onResolve({ filter: /^styles:$/ }, () => ({ path: "styles", namespace: "styles" }));
    builder.onLoad({ filter: /./, namespace: "styles" }, async () => ({ contents: await styles(), loader: "text" }));
  },
};

async function scripts() {
  const made = {}, used = new Set();
  for (const [name, [entry, format]] of Object.entries(ENTRIES)) {
    const { outputFiles, metafile } = await build({ ...OPTIONS, format, entryPoints: [entry], plugins: [workers, sheet] });
    made[`${name}.js`] = outputFiles[0].text;
    for (const path of Object.keys(metafile.inputs)) {
      const package_ = path.match(/node_modules\/((?:@[^/]+\/)?[^/]+)\//)?.[1];
      if (package_) used.add(package_);
    }
  }
  return { made, used };
}

async function styles() {
  const parts = [];
  for (const path of STYLES) parts.push((await readFile(join(here, path), "utf8")).trim());
  return `${parts.join("\n\n")}\n`;
}

async function licences(used) {
  const unnamed = [...used].filter((name) => !VENDORED.includes(name));
  if (unnamed.length) throw new Error(`${unnamed.join(", ")}: not among VENDORED, so its licence would be missing`);
  const parts = ["Code of others that is part of the scripts in this folder, with its licences."];
  for (const name of VENDORED.filter((name) => used.has(name))) {
    const folder = join(here, "node_modules", name);
    const { version } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
    const file = (await readdir(folder)).find((entry) => /^licen[cs]e/i.test(entry));
    if (!file) throw new Error(`${name} ${version} has no file of its licence`);
    parts.push(`${name} ${version}\n\n${(await readFile(join(folder, file), "utf8")).trim()}`);
  }
  return `${parts.join(`\n\n${"-".repeat(80)}\n\n`)}\n`;
}

const { made, used } = await scripts();
const files = { ...made, "explorer.css": await styles(), "LICENSES.txt": await licences(used) };
if (process.argv.includes("--check")) {
  const differing = [];
  for (const [name, text] of Object.entries(files)) {
    const path = join(STATIC, name);
    if (!existsSync(path) || (await readFile(path, "utf8")) !== text) differing.push(name);
  }
  if (differing.length) {
    console.error(`pipeline/explorer/static: ${differing.join(", ")} are not what page/ builds; run node build.mjs there`);
    process.exit(1);
  }
  console.log(`pipeline/explorer/static is what page/ builds: ${Object.keys(files).join(", ")}`);
} else {
  await mkdir(STATIC, { recursive: true });
  for (const [name, text] of Object.entries(files)) await writeFile(join(STATIC, name), text);
  for (const [name, text] of Object.entries(files)) console.log(`${name} ${Buffer.byteLength(text)} B`);
}
