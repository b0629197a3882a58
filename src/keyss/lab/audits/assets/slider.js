"use strict";
// Turns each group of pictures, which without this stand side by side, into two pictures under a slider.
for (const group of document.querySelectorAll(".compare")) {
  const stage = group.querySelector(".stage");
  const range = group.querySelector("input[type=range]");
  if (!range) continue;
  const shots = [...group.querySelectorAll(".shot")];
  const [left, right] = group.querySelectorAll("select");
  const difference = group.querySelector("input[type=checkbox]");

  const show = () => {
    shots.forEach((shot, index) => {
      shot.classList.toggle("left", index === Number(left.value));
      shot.classList.toggle("right", index === Number(right.value));
    });
    stage.style.setProperty("--at", `${range.value}%`);
    range.setAttribute("aria-valuetext", `${range.value} % ${left.selectedOptions[0].text}`);
    stage.classList.toggle("difference", difference.checked);
  };
  for (const control of [range, left, right, difference]) control.addEventListener("input", show);
  group.classList.add("live");
  show();
}
