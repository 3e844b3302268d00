// Lists whose rows change while the operator uses them.

// Show these rows and no others. One that is there already stays where it is: a button that is replaced or moved
// between press and release would lose the click.
export function placeRows(list, rows) {
  const kept = new Set(rows);
  for (const row of [...list.children]) if (!kept.has(row)) row.remove();
  let next = list.firstElementChild;
  for (const row of rows) {
    if (row === next) next = next.nextElementSibling;
    else list.insertBefore(row, next);
  }
}
