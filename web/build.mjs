/**
 * Builds the page: node build.mjs [FOLDER]
 *
 * page.html, a template whose comments <!--policy-->, <!--style-->, <!--model--> and <!--script--> `keyss.viewer` fills;
 * viewer.js; viewer.css; licences.txt. The same sources give the same bytes.
 */
import { readFileSync, mkdirSync, writeFileSync } from 'node:fs';
import { dirname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';
import { build } from 'esbuild';

const HERE = dirname(fileURLToPath(import.meta.url));
const OUT = resolve(process.argv[2] ?? join(HERE, '../src/keyss/viewer/assets'));
const SETTINGS = {
  absWorkingDir: HERE, bundle: true, minify: true, write: false, format: 'iife', target: 'es2022', charset: 'ascii',
  legalComments: 'none', metafile: true,
};

const used = new Set();

async function bundled(entry, plugins = []) {
  const result = await build({ ...SETTINGS, entryPoints: [entry], plugins });
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
    onLoad({ filter: /.*/, namespace: 'worker' }, async ({ path }) => ({ contents: await bundled(path, [workers]), loader: 'text' }));
  },
};

const script = await bundled('src/page/main.ts', [workers]);
const licences = [...used].sort().map((name) => {
  const folder = join(HERE, 'node_modules', name);
  const { version, license } = JSON.parse(readFileSync(join(folder, 'package.json'), 'utf8'));
  return `${name} ${version} (${license})\n\n${licenceOf(folder).trim()}\n`;
});

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

mkdirSync(OUT, { recursive: true });
writeFileSync(join(OUT, 'viewer.js'), script);
writeFileSync(join(OUT, 'viewer.css'), readFileSync(join(HERE, 'src/page/style.css'), 'utf8'));
writeFileSync(join(OUT, 'page.html'), readFileSync(join(HERE, 'src/page/index.html'), 'utf8'));
writeFileSync(join(OUT, 'licences.txt'), licences.join(`\n${'-'.repeat(78)}\n\n`));
