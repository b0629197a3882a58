/** Promises over the worker that reads files and tries keys. */
import WORKER from 'source:../worker.ts';
import { startWorker } from '../keys/keys.ts';
import type { Answer, Question } from '../worker.ts';

export class Opener {
  private readonly worker = startWorker(WORKER);
  private readonly waiting = new Map<number, (answer: Answer) => void>();
  private next = 0;

  /** `onProgress` receives the progress of an attempt, 0 to 1, at the same times for every key. */
  constructor(private readonly onProgress: (share: number) => void) {
    this.worker.onmessage = ({ data }: MessageEvent<Answer>) => {
      const resolve = this.waiting.get(data.id);
      if (resolve && data.progress !== undefined) return this.onProgress(data.progress);
      this.waiting.delete(data.id);
      resolve?.(data);
    };
    this.worker.onerror = () => {
      for (const [id, resolve] of this.waiting) resolve({ id, error: 'This file cannot be read.' });
      this.waiting.clear();
    };
  }

  /** The model in a file, or what a key opens. `transfer`: memory to hand over to the worker. */
  ask(question: Question, transfer: Transferable[] = []): Promise<Answer> {
    return new Promise((resolve) => {
      this.waiting.set(this.next, resolve);
      this.worker.postMessage({ ...question, id: this.next++ }, transfer);
    });
  }

  /** Cancels everything pending. */
  stop(): void {
    this.worker.postMessage({ stop: true } satisfies Question);
    for (const [id, resolve] of this.waiting) resolve({ id, stopped: true });
    this.waiting.clear();
  }
}
