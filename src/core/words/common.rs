//! Words that say nothing about a sign: function words, and what people write about where things are, in English, German,
//! French, Spanish and Italian.

/// Function words, in lower case, without accents.
const FUNCTION: &str = "\
a about after all also am an and any are around as at be been before but by can could did do does down each either for \
from had has have he her here hers him his how i if in into is it its just like maybe me my no none nor not now of off on \
one only onto or other our out over she so some than that the their them then there these they this those through to too \
two three four five six up us very was we were what when where which while who whose why will with within without would \
you your im ive id its theres thats youre dont isnt \
aber als am an auch auf aus bei bin bis da das dass dein dem den der des die dies diese diesem diesen dieser dieses doch \
du durch ein eine einem einen einer eines er es etwas euch fur gibt hab habe haben hat hier ich ihm ihn ihr im in ist ja \
kein keine man mein mich mir mit nach nicht noch nur ob oder schon sehr sehe sein sich sie sind so uber um und uns unter \
vom von vor war was wenn wer wie wir wird wo zu zum zur zwei drei vier \
ai au aux avec ce cela ces cet cette chez comme dans de des deux du elle elles en entre est et eux il ils j je l la le les \
leur lui ma mais mes moi mon ne nos notre nous on ou où par pas pour qu que qui sa sans se ses son sont suis sur ta te tes \
toi ton trois tu un une vers vois voit vos votre vous y \
al algo antes como con contra cual cuando de del desde donde dos el ella ellas ellos en entre era es esa ese eso esta este \
esto estoy hay hasta la las le les lo los mas me mi mis muy ni nos o otra otro para pero por porque que se si sin sobre son \
su sus tambien te tiene tres tu un una uno veo ver y ya yo \
ad agli ai al all alla alle allo anche c che chi ci col come con da dal dall dalla dalle degli dei del dell della delle dello di due e ed \
gli ha ho i il in io la le li lo ma mi nel nell nella nelle non o per piu quattro quello questa quell questo qui sei si sono sopra sta \
sto su sua sul sull sulla suo tra tre un una uno vedo";

/// What people write about where things are and what they look like, in lower case, without accents.
const PLACE: &str = "\
above across adjacent ahead along alongside away back behind below beneath beside between big black block blue bottom \
bright brown building buildings called center centre close closed closer corner corners crossing dark direction door doors \
far facade facing floor front green grey gray ground high house houses intersection junction large left letters light \
little located long look looking lost low main meter meters metre metres middle minutes named name names near nearby \
nearest next north south east west old opposite orange part pink place places plaza purple read reads reading red right \
road row same saw say saying says see seeing seen shop shops shopfront show showing shows side sides sidewalk sign signs \
signboard small somewhere square stand standing standpoint start store stores street streets tall text thing top toward \
towards tree trees turn wall walls white wide window windows word words yellow written \
benannt blau blaue daneben dort ecke eingang fassade fenster gebaude gegenuber gelb gelbe gelbes geschaft gross grosse grosses \
grun grune haus hauser heisst hinter hinten hoch klein kleine kleines laden linke linken linker links mitte nahe name namens \
neben oben platz rechte rechten rechter rechts rot rote rotes schild schilder schwarz schwarze seite steht stehe stehen \
strasse text tur unten vorne wand weiss weisse weisses zwischen \
angle appelle batiment bas blanc blanche bleu bleue boutique carrefour centre cote derriere devant droite ecrit enseigne \
face facade fenetre gauche grand grande gris haut immeuble jaune loin lisant magasin maison marque milieu mur noir noire nom \
nomme panneau petit petite place porte pres proche rouge rue texte trottoir vert verte \
abajo amarillo arriba azul blanca blanco calle cartel casa centro cerca cruce delante derecha detras dice edificio encima \
enfrente escrito esquina frente gran grande izquierda junto lado lejos letrero llama llamada llamado medio negra negro nombre \
pared pequena pequeno plaza puerta roja rojo texto tienda tiendas ventana verde \
accanto angolo alto basso bianca bianco blu casa centro cartello chiama chiamato davanti destra dice dietro edificio fianco \
finestra giallo grande incrocio insegna lato lontano mezzo muro negozi negozio nera nero nome palazzo parete piazza piccola \
piccolo porta rossa rosso scritta scritto sinistra strada testo verde via vicino";

/// Function words that only German has, of those above.
const GERMAN: &str = "\
aber auf aus bei bin das dem den der ein eine einem einen einer gibt ich im ist kein mit neben nicht oder rechts links sehe \
sind und vom von vor wir zu zum zur zwischen gegenuber steht stehe";

/// Whether a word says nothing about a sign, whatever its case. `word` is in lower case, without accents.
pub(super) fn is_function_word(word: &str) -> bool {
    FUNCTION.split_ascii_whitespace().any(|one| one == word)
}

/// Whether a word describes a place rather than naming it, unless it is part of a name. `word` is in lower case, without
/// accents.
pub(super) fn is_place_word(word: &str) -> bool {
    PLACE.split_ascii_whitespace().any(|one| one == word)
}

/// Whether a word is German. `word` is in lower case, without accents.
pub(super) fn is_german(word: &str) -> bool {
    GERMAN.split_ascii_whitespace().any(|one| one == word)
}
