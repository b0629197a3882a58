/** Passes questions to the worker that reads files and tries keys, one at a time. */
import WORKER from 'source:../worker.ts';
import { startWorker } from '../keys/keys.ts';
import type { Answer, Question } from '../worker.ts';

export class Opener {
  private readonly worker = startWorker(WORKER);
  private end = (_: Answer): void => undefined; // answers the pending question

  /** `onProgress` receives the progress of an attempt, 0 to 1, at the same times for every key. */
  constructor(private readonly onProgress: (share: number) => void) {
    this.worker.onerror = () => this.end({ error: 'This file cannot be read.' });
  }

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
      this.worker.postMessage(question, [port2, ...transfer]);
    });
  }

  /** Cancels the pending question. */
  stop(): void {
    this.worker.postMessage({ stop: true } satisfies Question);
    this.end({ stopped: true });
  }
}
