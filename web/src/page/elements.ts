/** What index.html has, by name. */

function element<T extends HTMLElement>(id: string): T {
  return document.getElementById(id) as T;
}

export const page = {
  main: element('main'),
  canvas: element<HTMLCanvasElement>('picture'),
  border: element('border'),
  drop: element('drop'),
  more: element<HTMLButtonElement>('more'),
  controls: element('controls'),
  file: element<HTMLInputElement>('file'),
  form: element<HTMLFormElement>('key-form'),
  colours: element<HTMLInputElement>('colours'),
  key: element<HTMLInputElement>('key'),
  show: element<HTMLButtonElement>('show'),
  open: element<HTMLButtonElement>('open'),
  status: element('status'),
  progress: element<HTMLProgressElement>('progress'),
  problem: element('problem'),
  facts: element('facts'),
  up: element<HTMLSelectElement>('up'),
  fly: element<HTMLButtonElement>('fly'),
  home: element<HTMLButtonElement>('home'),
  snapshot: element<HTMLButtonElement>('snapshot'),
  download: element<HTMLButtonElement>('download'),
  close: element<HTMLButtonElement>('close'),
  wipe: element<HTMLInputElement>('wipe'),
  revealed: element('revealed'),
  threshold: element<HTMLInputElement>('threshold'),
  thresholdText: element<HTMLOutputElement>('threshold-text'),
  faint: element<HTMLInputElement>('faint'),
  opaque: element<HTMLInputElement>('opaque'),
  colouring: element<HTMLSelectElement>('colouring'),
  count: element('count'),
};
