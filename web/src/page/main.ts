/** The page: a published model, a field for a key, and what the key opens. */
import WORKER from 'source:../worker.ts';
import { buffersOf, type Gaussians, withDegree } from '../core/gaussians.ts';
import { writePly } from '../files/ply.ts';
import type { HiddenFile } from '../hidden.ts';
import { startWorker } from '../keys/keys.ts';
import type { Answer, Question } from '../worker.ts';
import { Controls } from './controls.ts';
import { givenModel, notifyParent, params } from './embedding.ts';
import { count, page, preparePanel, save, showKey } from './panel.ts';
import { firstPose, type Pose, poseOfHash, poseToHash, transferPose, UPS } from './pose.ts';
import { Viewer } from './viewer.ts';

const ADDRESS_AFTER = 400; // ms after the last movement
const MAX_BYTES = 2 ** 31;
const HAS_SCREEN_KEYBOARD = window.matchMedia('(pointer: coarse)'); // which covers the picture
const NO_WEBGL = "Your browser doesn't support WebGL 2, which is needed to show the model.";
const SEARCHING = 'Nothing yet. Searching more thoroughly …';
const STOPPED = 'Search stopped: nothing found so far.';
const NOTHING = 'This key opens nothing: it may be wrong, this file may hold no secret, or the file was changed; '
  + 'check the key and ask for the original file.';
const INTERRUPTED = 'The browser interrupted graphics. The picture comes back by itself; if not, reload the page.';

/** Asks a worker, one question at a time. */
class Opener {
  private worker: Worker | null = null;
  private end = (_: Answer): void => undefined; // answers the pending question

  /** `onProgress` receives the progress of an attempt, 0 to 1, at the same times for every key. */
  constructor(private readonly onProgress: (share: number) => void) {}

  /** The model in a file, or what a key opens. `transfer`: memory to hand over to the worker. */
  ask(question: Question, transfer: Transferable[] = []): Promise<Answer> {
    return new Promise((resolve) => {
      const { port1, port2 } = new MessageChannel();
      this.end = (answer) => {
        port1.close();
        resolve(answer);
      };
      port1.onmessage = ({ data }: MessageEvent<Answer>) => {
        if (data.progress === undefined) this.end(data);
        else this.onProgress(data.progress);
      };
      this.worker ??= startWorker(WORKER);
      this.worker.onerror = () => this.end({ error: 'This file cannot be read.' });
      this.worker.postMessage(question, [port2, ...transfer]);
    });
  }

  /** Ends the worker at once, whatever it does; the next question starts another. */
  stop(): void {
    this.worker?.terminate();
    this.worker = null;
    this.end({ stopped: true });
  }
}

class Page {
  private name = 'model';
  private published: Gaussians | null = null;
  private secret: Gaussians | null = null;
  private readonly reader = new Opener((share) => this.showProgress(share));
  private readonly searcher = new Opener((share) => this.showProgress(share)); // of the slow channels, which new keys interrupt
  private readonly controls: Controls;
  private pose: Pose = { eye: [0, 0, -1], target: [0, 0, 0], up: UPS['-y'] };
  private readonly homes = new WeakMap<Gaussians, Pose>(); // first poses
  private addressTimer = 0;
  private hash = location.hash; // as the user opened it; the page writes its own later
  private work = 0; // number of loads and attempts; results of outdated ones are dropped

  /** Without a viewer, keys can be tried and nothing is drawn. */
  constructor(private readonly viewer: Viewer | null) {
    this.controls = new Controls(page.picture, this.pose, (pose) => this.setPose(pose), () => this.firstPose());
    this.listen();
    page.drawn.disabled = page.wipe.disabled = viewer === null;
  }

  private listen(): void {
    preparePanel((file) => void this.openFile(file));
    page.form.addEventListener('submit', (event) => {
      event.preventDefault();
      void this.unlock();
    });
    this.controls.onRotate = (on) => page.rotate.setAttribute('aria-pressed', String(on));
    page.rotate.addEventListener('click', () => this.controls.rotate(!this.controls.isRotating));
    page.border.addEventListener('pointerdown', ({ pointerId }) => page.border.setPointerCapture(pointerId));
    page.border.addEventListener('pointermove', ({ pointerId, clientX }) => {
      if (!page.border.hasPointerCapture(pointerId)) return;
      const { left, width } = page.view.getBoundingClientRect();
      this.split(Math.max(0.01, Math.min(0.99, (clientX - left) / width)));
    });
    page.background.addEventListener('input', () => this.viewer?.setBackground(page.background.value));
    page.picture.addEventListener('webglcontextlost', () => this.say(INTERRUPTED));
    page.picture.addEventListener('webglcontextrestored', () => this.say(''));
    page.stop.addEventListener('click', () => this.searcher.stop());
    page.home.addEventListener('click', () => this.controls.setPose(this.firstPose()));
    page.snapshot.addEventListener('click', () => void this.snapshot());
    page.download.addEventListener('click', () => {
      if (this.secret) save('secret.ply', new Blob([writePly(this.secret) as BlobPart]));
    });
    page.close.addEventListener('click', () => this.closeSecret());
    page.wipe.addEventListener('input', () => this.split(1 - Number(page.wipe.value) / 100));
    if (page.main.dataset.background) page.background.value = page.main.dataset.background;
    this.viewer?.setBackground(page.background.value);
    window.addEventListener('hashchange', ({ newURL }) => {
      this.hash = new URL(newURL).hash; // location.hash may have been overwritten by the page
      const pose = poseOfHash(this.hash);
      if (pose) this.controls.setPose(pose);
    });
  }

  /** Opens the model in the page, beside it, or in its address. */
  async start(): Promise<void> {
    const source = givenModel();
    if (source === null) return this.say('Open a file, or drop one here.');
    if (params.poster) page.poster.src = params.poster;
    page.poster.hidden = !params.poster;
    this.say('Loading …');
    const bytes = await source.bytes((share) => this.say(`Loading … ${Math.floor(100 * share)} %`)).catch(() => null);
    return bytes ? this.load(bytes, source.name) : this.fail('The file in the address could not be loaded.');
  }

  private async openFile(file: File): Promise<void> {
    if (file.size > MAX_BYTES) return this.fail('This file is larger than 2 GiB.');
    for (const given of ['pose', 'up', 'title']) delete page.main.dataset[given]; // of the first file
    return this.load(new Uint8Array(await file.arrayBuffer()), file.name);
  }

  private async load(bytes: Uint8Array, name: string): Promise<void> {
    const work = this.startWork();
    this.say('Reading …');
    page.problem.textContent = this.viewer ? '' : NO_WEBGL;
    const { model, error } = await this.reader.ask({ bytes, name }, [bytes.buffer]);
    if (work !== this.work) return;
    if (model === undefined) return this.fail(error ?? 'This file cannot be read.');
    [this.name, this.published] = [(this.work === 1 && params.title) || (page.main.dataset.title ?? name), model];
    this.hideSecret();
    page.open.disabled = page.key.disabled = false;
    page.facts.textContent = `${this.name}\n${count(model.count)} Gaussians, SH degree ${model.shDegree}`;
    document.title = `${this.name} · keyss viewer`;
    this.viewer?.show(model);
    this.controls.setPose(poseOfHash(this.hash) ?? this.firstPose());
    await this.settle();
    this.say('');
    page.poster.hidden = true;
    notifyParent({ event: 'load', gaussians: model.count });
    this.controls.rotate(params.autorotate && !window.matchMedia('(prefers-reduced-motion: reduce)').matches);
  }

  /**
   * Every key makes both searches, the thorough one silently if the quick one found something. The form is ready again after
   * the quick search, before a secret is decoded and rendered.
   */
  private async unlock(): Promise<void> {
    const [key, published] = [page.key.value, this.published];
    if (!key || published === null || page.open.disabled) return;
    const work = this.startWork();
    if (HAS_SCREEN_KEYBOARD.matches) page.key.blur();
    this.controls.rotate(false);
    this.writeAddress(); // before the key opens anything
    this.say('Trying the key …');
    let said = '';
    for (const search of ['quick', 'thorough'] as const) {
      this.showSearch(said ? 'silent' : search);
      if (!said) delete page.main.dataset.picture;
      const answer = await (search === 'quick' ? this.reader.ask({ key }) : this.searchThoroughly(key, published, Boolean(said)));
      if (work !== this.work) return;
      this.showSearch('');
      if (search === 'quick') notifyParent({ event: 'key-tried' });
      else this.searcher.stop(); // frees its memory
      const news = this.show(answer);
      if (said && !news) return;
      said = [said, news].filter(Boolean).join(' ');
      this.say(said || (search === 'quick' ? SEARCHING : answer.stopped ? STOPPED : NOTHING));
      await this.settle();
      if (work !== this.work) return;
    }
  }

  /** In a worker of its own, so that the next key need not wait. */
  private searchThoroughly(key: string, published: Gaussians, silent: boolean): Promise<Answer> {
    const model = withDegree(published, 0);
    return this.searcher.ask({ key, model, silent }, buffersOf(model));
  }

  /** Shows what a key opened; returns sentences about it, empty for nothing. */
  private show({ model, file, elsewhere, foreign }: Answer): string {
    if (file || model) notifyParent({ event: 'opened', kind: file ? 'file' : 'model' });
    const sentences = [
      file && this.offer(file), model && this.reveal(model),
      elsewhere && 'The key opens a model that only keyss reveal shows.',
      foreign && `About ${count(foreign)} Gaussians of the file were added or changed: it may not be its secret.`,
    ];
    return sentences.filter(Boolean).join(' ');
  }

  /** Starts a load or an attempt, and ends the thorough search of the last one. */
  private startWork(): number {
    this.searcher.stop();
    this.showSearch('');
    return ++this.work;
  }

  private showProgress(share: number): void {
    if (share < 1) page.progress.value = share;
    else this.showSearch('');
  }

  private showSearch(search: 'quick' | 'thorough' | 'silent' | ''): void {
    const isBusy = search === 'quick';
    page.main.dataset.searching = search;
    page.progress.value = 0;
    if (isBusy === page.open.disabled || this.published === null) return;
    page.open.disabled = isBusy;
    page.main.setAttribute('aria-busy', String(isBusy));
    if (isBusy) return;
    page.key.value = '';
    showKey(false);
  }

  private offer(file: HiddenFile): string {
    const name = file.name.replace(/[^\p{L}\p{N} ._-]/gu, '_') || 'file';
    page.save.textContent = `Save ${name} (${count(file.bytes.length)} bytes)`;
    page.save.onclick = () => save(name, new Blob([file.bytes as BlobPart]));
    page.save.hidden = false;
    return 'The key reveals a file.';
  }

  /** Shows the secret from where the last model was seen. */
  private reveal(model: Gaussians): string {
    if (page.keying.name) page.keying.open = false; // on phones
    const pose = this.sameView(this.pose, this.secret ?? this.published ?? model, model);
    this.showSecret(model, 0);
    this.controls.setPose(pose);
    return `The key reveals a model of ${count(model.count)} Gaussians.`;
  }

  private closeSecret(): void {
    const pose = this.secret && this.published ? this.sameView(this.pose, this.secret, this.published) : this.pose;
    this.hideSecret();
    this.controls.setPose(pose);
    this.writeAddress();
    this.say('');
    if (!HAS_SCREEN_KEYBOARD.matches) page.key.focus();
  }

  private hideSecret(): void {
    this.showSecret(null, 1);
    page.save.hidden = true;
  }

  private showSecret(model: Gaussians | null, share: number): void {
    this.secret = model;
    this.viewer?.show(model, 'right');
    this.split(share);
  }

  /** Sets the share of the width for the published model beside the secret. */
  private split(share: number): void {
    page.revealed.hidden = this.secret === null;
    page.wipe.value = String(100 * (1 - share));
    this.viewer?.setSplit(share);
    page.border.hidden = share <= 0 || share >= 1;
    page.border.style.left = `${100 * share}%`;
  }

  private async snapshot(): Promise<void> {
    this.controls.rotate(false); // otherwise no picture is at rest
    const picture = await this.viewer?.snapshot();
    if (picture) save(`${this.name.replace(/\.\w+$/, '') || 'view'}.png`, picture);
  }

  /** The first pose of the model shown, recomputed, as the window size may have changed. */
  private firstPose(): Pose {
    const model = this.secret ?? this.published;
    if (model === null) return this.pose;
    this.homes.delete(model);
    return this.home(model);
  }

  /** A model's first pose: of the published model, that of the page. */
  private home(model: Gaussians): Pose {
    const { pose, up } = page.main.dataset;
    const aspect = page.picture.clientWidth / Math.max(1, page.picture.clientHeight) || 1;
    const isOwn = model === this.published;
    const given = this.homes.get(model) ?? (isOwn ? poseOfHash(pose ?? '') : null);
    const home = given ?? firstPose(model, aspect, isOwn ? UPS[up ?? ''] : undefined);
    this.homes.set(model, home);
    return home;
  }

  private sameView(pose: Pose, from: Gaussians, to: Gaussians): Pose {
    return from === to ? pose : transferPose(pose, this.home(from), this.home(to));
  }

  private setPose(pose: Pose): void {
    this.pose = pose;
    if (this.secret) this.viewer?.setPose(pose, 'right');
    this.viewer?.setPose(this.secret && this.published ? this.sameView(pose, this.secret, this.published) : pose);
    clearTimeout(this.addressTimer);
    this.addressTimer = window.setTimeout(() => this.writeAddress(), ADDRESS_AFTER);
  }

  /** Not while a secret is shown, whose coordinates would be in the address. */
  private writeAddress(): void {
    clearTimeout(this.addressTimer);
    const hash = poseToHash(this.pose);
    if (this.published && !this.secret && location.hash !== hash) history.replaceState(null, '', hash);
  }

  private async settle(): Promise<void> {
    delete page.main.dataset.picture;
    await this.viewer?.settled();
    page.main.dataset.picture = 'settled';
  }

  private say(text: string): void {
    page.status.textContent = text;
  }

  private fail(text: string): void {
    this.say('');
    page.problem.textContent = text;
  }
}

async function main(): Promise<void> {
  page.main.dataset.panel = params.panel;
  const viewer = await Viewer.create(page.picture).catch(() => null);
  page.problem.textContent = viewer ? '' : NO_WEBGL;
  const shown = new Page(viewer);
  if (params.panel === 'key') page.keying.open = true; // folded on phones by default
  await shown.start();
}

void main();
