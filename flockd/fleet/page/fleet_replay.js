// Plays recordings of a whole fleet on one time line.

const ASK_EVERY_MS = 200;

export class ReplayControls {
  constructor(form, ask) {
    [this.form, this.ask] = [form, ask];
    this.button = form.querySelector("button");
    this.slider = form.elements.time;
    this.rate = form.elements.rate;
    this.span = null;
    this.playing = false;
    this.button.addEventListener("click", () => this.play(!this.playing));
    this.slider.addEventListener("input", () => this.go(Number(this.slider.value)));
  }

  begin(span) {
    if (this.span) return this.go(this.at);
    this.span = span;
    this.form.hidden = false;
    [this.slider.min, this.slider.max] = [0, span[1] - span[0]];
    setInterval(() => this.tick(), ASK_EVERY_MS);
    this.go(0);
    return this.play(true);
  }

  play(playing) {
    if (playing && this.at >= this.span[1] - this.span[0]) this.go(0);
    this.playing = playing;
    this.before = performance.now();
    this.button.textContent = playing ? "Pause" : "Play";
  }

  tick() {
    if (!this.playing) return;
    const now = performance.now();
    this.go(this.at + (Number(this.rate.value) * (now - this.before)) / 1000);
    this.before = now;
    if (this.at >= this.span[1] - this.span[0]) this.play(false);
  }

  go(at) {
    this.at = Math.min(Math.max(at, 0), this.span[1] - this.span[0]);
    this.ask(this.span[0] + this.at);
  }

  shown(time) {
    if (!this.span) return;
    if (document.activeElement !== this.slider || this.playing) this.slider.value = time - this.span[0];
    this.form.querySelector("output").textContent = `${this.label(time)} of ${this.label(this.span[1])}`;
  }

  label(time) {
    const seconds = time - this.span[0];
    return `${Math.floor(seconds / 60)}:${(seconds % 60).toFixed(1).padStart(4, "0")}`;
  }
}
