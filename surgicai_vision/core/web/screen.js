// The newest status and images come in. A page has figures with data-view and a canvas each.
"use strict";

const element = (id) => document.getElementById(id);

function setText(id, text) {
  if (element(id).textContent !== String(text)) element(id).textContent = text;
}

async function drawView(figure, number) {
  const view = figure.dataset.view;
  const answer = await fetch(`view/${view}.jpg?n=${number}`);
  if (!answer.ok) return;
  const image = await createImageBitmap(await answer.blob());
  const canvas = figure.querySelector("canvas");
  if (canvas.width !== image.width) { canvas.width = image.width; canvas.height = image.height; }
  canvas.getContext("2d").drawImage(image, 0, 0);
  image.close();
}

// Calls show(status) with every new status, then draws the figures, until the state is "stopped"; lost() while nobody answers.
async function follow(show, lost) {
  let seen = 0, shown = 0;
  for (let stopped = false; !stopped;) {
    try {
      const status = await (await fetch(`status?after=${seen}`)).json();
      if (!status.state || status.number === seen) continue;
      seen = status.number;
      await show(status);
      stopped = status.state === "stopped";
      if (status.image !== shown) {
        await Promise.all([...document.querySelectorAll("figure")].map((figure) => drawView(figure, status.image)));
        shown = status.image;
      }
    } catch (error) {
      lost();
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}
