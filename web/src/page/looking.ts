/** The part of the panel that looks without a key: what was chosen there, and how many Gaussians that leaves. */
import { type Gaussians, opacity } from '../core/gaussians.ts';
import { type Look, lookedAt } from './attacker.ts';
import { page } from './elements.ts';
import { count } from './panel.ts';

const FAINT = 0.1; // opacity below which Gaussians are called faint, unless another threshold is chosen
const AFTER = 100; // milliseconds after the last change of a slider
const LEAST_DRAWN = 1 / 255; // opacity

/** `changed` is called when something else is to be looked at. */
export function listenToLooks(changed: () => void): void {
  let timer = 0;
  page.faint.addEventListener('input', () => {
    if (page.faint.checked && Number(page.threshold.value) === 0) page.threshold.value = String(FAINT);
  });
  for (const input of [page.threshold, page.faint, page.opaque, page.colouring]) {
    input.addEventListener('input', () => {
      page.thresholdText.value = Number(page.threshold.value).toFixed(3);
      clearTimeout(timer);
      timer = window.setTimeout(changed, AFTER);
    });
  }
}

/** What is to be seen of a model; says how many of its Gaussians that are. */
export function looked(model: Gaussians): Gaussians {
  const found = lookedAt(model, {
    threshold: Number(page.threshold.value),
    faintOnly: page.faint.checked,
    opaque: page.opaque.checked,
    colouring: page.colouring.value as Look['colouring'],
  });
  const faint = model.opacityLogits.filter((logit) => opacity(logit) < LEAST_DRAWN).length;
  page.count.textContent =
    `${count(found.count)} of ${count(model.count)} Gaussians shown; ${count(faint)} are too faint to be drawn`;
  return found;
}
