/**
 * Builds the page: node build.mjs [FOLDER]
 *
 * page.html, a template whose comments <!--policy-->, <!--style-->, <!--model--> and <!--script--> `keyss.viewer` fills;
 * viewer.js; viewer.css; embed.js, a custom element for other sites; licences.txt. The same sources give the same bytes.
 *
 * Or the package keyss-reader: node build.mjs --reader [FOLDER]; `npm pack` in the folder makes an archive of it.
 */
import { copyFileSync, cpSync, readFileSync, mkdirSync, writeFileSync } from 'node:fs';
import { dirname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';
import { build } from 'esbuild';

const HERE = dirname(fileURLToPath(import.meta.url));
const SETTINGS = {
  absWorkingDir: HERE, bundle: true, minify: true, write: false, format: 'iife', target: 'es2022', charset: 'ascii',
  legalComments: 'none', metafile: true,
};

const used = new Set();

async function bundled(entry, settings = {}) {
  const result = await build({ ...SETTINGS, ...settings, entryPoints: [entry] });
  for (const input of Object.keys(result.metafile.inputs)) {
    const found = /node_modules\/((?:@[^/]+\/)?[^/]+)\//.exec(input);
    if (found) used.add(found[1]);
  }
  return result.outputFiles[0].text;
}

/** `import TEXT from 'source:FILE'` gives the bundled script of a worker. */
const workers = {
  name: 'workers',
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^source:/ }, ({ path, resolveDir }) => ({
      path: join(resolveDir, path.slice('source:'.length)), namespace: 'worker',
    }));
    onLoad({ filter: /.*/, namespace: 'worker' }, async ({ path }) => ({
      contents: await bundled(path, { plugins: [workers] }), loader: 'text',
    }));
  },
};

/** Of every package whose code the bundles contain. */
function licences() {
  const each = [...used].sort().map((name) => {
    const folder = join(HERE, 'node_modules', name);
    const { version, license } = JSON.parse(readFileSync(join(folder, 'package.json'), 'utf8'));
    return `${name} ${version} (${license})\n\n${licenceOf(folder).trim()}\n`;
  });
  return each.join(`\n${'-'.repeat(78)}\n\n`);
}

function licenceOf(folder) {
  for (const name of ['LICENSE', 'LICENSE.md', 'LICENSE.txt', 'license']) {
    try {
      return readFileSync(join(folder, name), 'utf8');
    } catch {
      // the next name
    }
  }
  throw new Error(`no licence in ${folder}`);
}

async function buildPage(out) {
  const script = await bundled('src/page/main.ts', { plugins: [workers] });
  mkdirSync(out, { recursive: true });
  writeFileSync(join(out, 'viewer.js'), script);
  writeFileSync(join(out, 'embed.js'), await bundled('src/embed.ts'));
  writeFileSync(join(out, 'viewer.css'), readFileSync(join(HERE, 'src/page/style.css'), 'utf8'));
  writeFileSync(join(out, 'page.html'), readFileSync(join(HERE, 'src/page/index.html'), 'utf8'));
  writeFileSync(join(out, 'licences.txt'), licences());
}

async function buildReader(out) {
  const script = await bundled('src/reader.ts', { format: 'esm', platform: 'neutral', mainFields: ['module', 'main'] });
  const [, version] = /__version__ = "(.*)"/.exec(readFileSync(join(HERE, '../src/keyss/_version.py'), 'utf8'));
  const description = JSON.parse(readFileSync(join(HERE, 'reader/package.json'), 'utf8'));
  mkdirSync(out, { recursive: true });
  writeFileSync(join(out, 'index.js'), script);
  writeFileSync(join(out, 'licences.txt'), licences());
  writeFileSync(join(out, 'package.json'), `${JSON.stringify({ ...description, version }, null, 2)}\n`);
  for (const name of ['reader/index.d.ts', 'reader/README.md', '../LICENSE']) {
    copyFileSync(join(HERE, name), join(out, name.split('/').pop()));
  }
  cpSync(join(HERE, 'reader/examples'), join(out, 'examples'), { recursive: true });
}

const [first, second] = process.argv.slice(2);
if (first === '--reader') await buildReader(resolve(second ?? join(HERE, '../out/keyss-reader')));
else await buildPage(resolve(first ?? join(HERE, '../src/keyss/viewer/assets')));
