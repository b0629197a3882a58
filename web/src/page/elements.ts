/** What index.html has, by name. */

/** The elements of one kind. */
function all<T extends HTMLElement>() {
  return <Name extends string>(...names: Name[]) =>
    Object.fromEntries(names.map((name) => [name, document.getElementById(name)])) as Record<Name, T>;
}

export const page = {
  ...all()('main', 'border', 'drop', 'controls', 'status', 'problem', 'facts', 'revealed', 'count'),
  ...all<HTMLInputElement>()('file', 'colours', 'key', 'wipe', 'threshold', 'faint', 'opaque'),
  ...all<HTMLButtonElement>()('more', 'show', 'open', 'fly', 'home', 'snapshot', 'download', 'close', 'save'),
  ...all<HTMLSelectElement>()('up', 'colouring'),
  ...all<HTMLCanvasElement>()('picture'),
  ...all<HTMLFormElement>()('form'),
  ...all<HTMLProgressElement>()('progress'),
  ...all<HTMLOutputElement>()('shown'),
};
