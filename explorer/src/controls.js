// The form: a slider and a box for each number, and choices.
import { GROUPS, INITIAL, MODES, NUMBERS, entered, rounded } from "./model.js";

const PLACES = 400; // of a slider

const logOf = (number, value) => Math.log(value / number.low) / Math.log(number.high / number.low);

export function placeOf(number, value, high) {
  const top = Math.min(number.high, high);
  if (number.scale === "linear") return Math.round((PLACES * (value - number.low)) / (top - number.low));
  if (number.zero && value < number.low) return 0;
  return Math.round((number.zero ? 1 : 0) + (PLACES - (number.zero ? 1 : 0)) * logOf(number, value));
}

export function valueAt(number, place, high) {
  const top = Math.min(number.high, high);
  if (number.scale === "linear") return Number((number.low + ((top - number.low) * place) / PLACES).toPrecision(3));
  if (number.zero && place === 0) return 0;
  const share = (place - (number.zero ? 1 : 0)) / (PLACES - (number.zero ? 1 : 0));
  return rounded(number, Number((number.low * (number.high / number.low) ** share).toPrecision(number.whole ? 4 : 3)));
}

const element = (name, attributes = {}, ...children) => {
  const made = Object.assign(document.createElement(name), attributes);
  made.append(...children);
  return made;
};

export class Controls {
  /** `change(changes, warning)` is called with what the reader sets, and what of it could not be taken as it was. */
  constructor(form, change) {
    this.form = form;
    this.rows = {};
    for (const group of GROUPS) {
      const body = element("div", { className: "numbers" });
      if (group.name === "Detector") body.append(this.#choice("mode", "Mode", MODES, change), this.#choice("start", "At the start of the exposure", ["armed", "stationary"], change));
      for (const number of group.numbers) body.append(this.#number(number, change));
      form.append(group.folded
        ? element("details", { className: "group" }, element("summary", { textContent: group.name }), body)
        : element("fieldset", { className: "group" }, element("legend", { textContent: group.name }), body));
    }
    form.addEventListener("submit", (event) => event.preventDefault());
  }

  #choice(key, label, choices, change) {
    const select = element("select", { id: key, onchange: () => change({ [key]: select.value }) });
    select.append(...choices.map((choice) => element("option", { value: choice, textContent: choice })));
    const row = element("div", { className: "choice" }, element("label", { htmlFor: key, textContent: label }), select);
    this.rows[key] = { row, select };
    return row;
  }

  #number(number, change) {
    const { key, label, unit } = number;
    const slider = element("input", { type: "range", id: `${key}-slider`, min: 0, max: PLACES, step: 1, ariaLabel: `${label}${unit ? `, ${unit}` : ""}` });
    const box = element("input", { type: "number", id: key, step: "any", min: number.zero ? 0 : number.low, max: number.high });
    slider.addEventListener("input", () => change({ [key]: valueAt(number, Number(slider.value), this.most(number)) }));
    box.addEventListener("change", () => {
      const { value, changed } = entered(number, box.value, this.state[key]);
      if (changed) box.value = value;
      change({ [key]: value }, changed);
    });
    const name = element("label", { htmlFor: key, textContent: label });
    if (unit) name.append(" ", element("span", { className: "unit", textContent: unit }));
    const row = element("div", { className: "number" }, name, box, slider);
    this.rows[key] = { row, slider, box };
    return row;
  }

  most(number) {
    return number.most === "period" ? this.state?.period ?? number.high : number.high;
  }

  /** As the state says; `fixed`: keys that cannot be set now. */
  show(state, fixed = []) {
    this.state = state;
    for (const number of NUMBERS) {
      const { row, slider, box } = this.rows[number.key], value = state[number.key];
      row.hidden = (number.mode !== undefined && number.mode !== state.mode) || (number.with !== undefined && state[number.with] === 0);
      slider.disabled = box.disabled = fixed.includes(number.key);
      const place = placeOf(number, value, this.most(number));
      if (Number(slider.value) !== place && document.activeElement !== slider) slider.value = place;
      slider.setAttribute("aria-valuetext", `${value} ${number.unit}`);
      const shown = Number(value.toPrecision(5));
      if (Number(box.value) !== shown || box.value === "") box.value = shown;
    }
    for (const key of ["mode", "start"]) {
      this.rows[key].select.value = state[key];
      this.rows[key].select.disabled = fixed.includes(key);
    }
    const effects = this.form.querySelector("details summary");
    const on = GROUPS.find((group) => group.folded).numbers.filter(({ key }) => key !== "trapDelay" && state[key] !== INITIAL[key]).length;
    effects.textContent = on ? `Effects (${on} on)` : "Effects";
  }
}
