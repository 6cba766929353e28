// Pictures of a value of every pixel, on a canvas that answers clicks and arrow keys.

export class Picture {
  /** `pick(row, column)` is called for a pixel that is clicked, or moved to by the arrow keys. */
  constructor(figure, colours, pick) {
    this.canvas = figure.querySelector("canvas");
    this.low = figure.querySelector(".low");
    this.high = figure.querySelector(".high");
    this.colours = colours;
    this.selected = null;
    figure.querySelector(".scale").style.background =
      `linear-gradient(to right, ${colours.map((c) => `rgb(${c.join(" ")})`).join(", ")})`;
    this.canvas.addEventListener("click", (event) => {
      const box = this.canvas.getBoundingClientRect();
      const column = Math.floor(((event.clientX - box.left) / box.width) * this.width);
      const row = Math.floor(((event.clientY - box.top) / box.height) * this.height);
      if (row >= 0 && column >= 0 && row < this.height && column < this.width) pick(row, column);
    });
    this.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
      if (!step || !this.width) return;
      event.preventDefault();
      const [row, column] = this.selected ?? [this.height >> 1, this.width >> 1];
      pick(Math.min(Math.max(row + step[0], 0), this.height - 1), Math.min(Math.max(column + step[1], 0), this.width - 1));
    });
  }

  /** Values (height * width), NaN for none, from `low` to `high` in the colours; `told` says a value in words. */
  show(values, height, width, [low, high], told) {
    [this.height, this.width] = [height, width];
    this.canvas.style.aspectRatio = `${width} / ${height}`;
    const image = new ImageData(width, height), last = this.colours.length - 1;
    for (let p = 0; p < values.length; ++p) {
      if (Number.isNaN(values[p])) continue;
      const x = Math.min(Math.max((values[p] - low) / (high - low || 1), 0), 1) * last, k = Math.min(Math.floor(x), last - 1);
      for (let c = 0; c < 3; ++c)
        image.data[4 * p + c] = this.colours[k][c] + (x - k) * (this.colours[k + 1][c] - this.colours[k][c]);
      image.data[4 * p + 3] = 255;
    }
    this.image = image;
    this.low.textContent = told(low);
    this.high.textContent = told(high);
    this.#paint();
  }

  /** Marks a pixel; null: none. */
  select(selected) {
    if (String(this.selected) === String(selected)) return;
    this.selected = selected;
    this.#paint();
  }

  async #paint() {
    if (!this.image) return;
    const zoom = Math.max(1, Math.round(512 / this.width)), context = this.canvas.getContext("2d");
    const bitmap = await createImageBitmap(this.image);
    [this.canvas.width, this.canvas.height] = [zoom * this.width, zoom * this.height];
    context.imageSmoothingEnabled = false;
    context.drawImage(bitmap, 0, 0, this.canvas.width, this.canvas.height);
    if (!this.selected) return;
    const [row, column] = this.selected;
    for (const [style, grown, line] of [["#000", 2, 5], ["#fff", 2, 2]]) {
      context.strokeStyle = style;
      context.lineWidth = line;
      context.strokeRect(zoom * column - grown, zoom * row - grown, zoom + 2 * grown, zoom + 2 * grown);
    }
  }
}
