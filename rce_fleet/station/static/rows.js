// Lists whose rows change while the operator uses them.

// Whether something in a list is pressed. Until its release the list stays as it is: a row that is moved or made again
// would lose the click, or give it to another one. The next drawing shows what changed meanwhile.
export const isPressed = (list) => list.querySelector(":active") !== null;

// Show these rows and no others. One that is there already stays where it is, with its focus.
export function placeRows(list, rows) {
  const kept = new Set(rows);
  for (const row of [...list.children]) if (!kept.has(row)) row.remove();
  let next = list.firstElementChild;
  for (const row of rows) {
    if (row === next) next = next.nextElementSibling;
    else list.insertBefore(row, next);
  }
}
