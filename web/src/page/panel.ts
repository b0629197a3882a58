/** The elements of index.html by id, and the behaviour that needs no model: showing the key, dropping files. */

function all<T extends HTMLElement>() {
  return <Name extends string>(...names: Name[]) =>
    Object.fromEntries(names.map((name) => [name, document.getElementById(name)])) as Record<Name, T>;
}

export const page = {
  ...all()('main', 'border', 'drop', 'view', 'status', 'problem', 'facts', 'revealed'),
  ...all<HTMLInputElement>()('file', 'key', 'wipe', 'background'),
  ...all<HTMLButtonElement>()('show', 'open', 'stop', 'home', 'snapshot', 'download', 'close', 'save', 'rotate', 'fullscreen'),
  ...all<HTMLCanvasElement>()('picture'),
  ...all<HTMLFormElement>()('form'),
  ...all<HTMLProgressElement>()('progress'),
  ...all<HTMLFieldSetElement>()('drawn'),
  ...all<HTMLDetailsElement>()('controls', 'keying'),
  ...all<HTMLImageElement>()('poster'),
};

const SMALL = '(max-width: 600px), (max-height: 500px) and (pointer: coarse)'; // the panel would cover the scene, or be cut

/** `opened` receives chosen and dropped files. */
export function preparePanel(opened: (file: File) => void): void {
  page.controls.open = page.keying.open = !window.matchMedia(SMALL).matches;
  if (!page.keying.open) page.controls.name = page.keying.name = 'folded'; // of one name, one is open at a time
  page.fullscreen.hidden = !document.fullscreenEnabled;
  page.fullscreen.addEventListener('click', () => {
    void (document.fullscreenElement ? document.exitFullscreen() : page.main.requestFullscreen());
  });
  page.show.addEventListener('click', () => showKey(page.key.type === 'password'));
  page.file.addEventListener('change', () => {
    const file = page.file.files?.[0];
    page.file.value = ''; // allows choosing the same file again
    if (file) opened(file);
  });
  document.addEventListener('dragover', (event) => {
    event.preventDefault();
    page.drop.hidden = !event.dataTransfer?.types.includes('Files');
  });
  document.addEventListener('dragleave', (event) => {
    if (event.relatedTarget === null) page.drop.hidden = true;
  });
  document.addEventListener('drop', (event) => {
    event.preventDefault();
    page.drop.hidden = true;
    const file = event.dataTransfer?.files[0];
    if (file) opened(file);
  });
}

export function showKey(shown: boolean): void {
  page.key.type = shown ? 'text' : 'password';
  page.show.setAttribute('aria-pressed', String(shown));
}

export function count(number: number): string {
  return number.toLocaleString('en');
}

export function save(name: string, data: Blob): void {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(data);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
